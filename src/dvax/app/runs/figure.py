"""The headline figures of a run, as summary.json holds them."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

SAYS_NOTHING = "; it is not finite, so it gives no bound"


@dataclass(frozen=True)
class Figure:
    """A headline figure: a number, or a list of them; `error`: a proved bound on its error, or on those
    of its entries, where there is one. A figure that is a bound itself says in `bound` how much is
    known of it: "proved", "declared" or "estimated", in `relative` its ratio to the norm of the
    computed solution, where this is positive, and in `why` the reason if it is not finite."""

    value: Any
    unit: str
    meaning: str
    error: Any = None
    bound: str | None = None
    relative: float | None = None
    why: str = ""

    def to_json(self) -> dict[str, Any]:
        """The entry of summary.json. The meaning of a bound says where it is infinite or NaN."""
        value = _plain(self.value)
        entry = {"value": value, "unit": self.unit, "meaning": self.meaning}
        if self.error is not None:
            entry["error"] = _plain(self.error)
        if self.bound is not None:
            values = value if isinstance(value, list) else [value]
            finite = all(math.isfinite(v) for v in values if isinstance(v, float))
            entry["meaning"] += "" if finite else SAYS_NOTHING
            entry["bound"] = self.bound
            if not finite and self.why:
                entry["why"] = self.why
        if self.relative is not None and math.isfinite(self.relative):
            entry["relative"] = float(self.relative)
        return entry


def _plain(value: Any) -> Any:
    """A number or list as JSON has it."""
    array = np.asarray(value)
    return array.tolist() if array.ndim or isinstance(value, np.generic | np.ndarray) else value
