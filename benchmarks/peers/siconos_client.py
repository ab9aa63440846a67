"""Siconos from here: a process of the Python that has it, spoken to line by line."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from ..contact_law import ContactLaw

_PROGRAM = Path(__file__).with_name("siconos_contact.py")
_PYTHONS = (sys.executable, "/usr/bin/python3", "python3")
_LETTERS = ("alpha", "beta", "b_x", "b_u", "d_x", "d_u", "kappa0", "ell", "x0")


def python() -> str | None:
    """A Python that imports Siconos: this one, the system's (Debian: python3-siconos), or None."""
    for candidate in _PYTHONS:
        try:
            answer = subprocess.run(
                [candidate, "-c", "import siconos.kernel, siconos.numerics"],
                capture_output=True, timeout=60, check=False,
            )  # fmt: skip
        except OSError:
            continue
        if answer.returncode == 0:
            return candidate
    return None


class Siconos:
    """A running Siconos process, to be used in a `with` statement.

    Some of its solvers report success with NaN, and print a warning where they did not converge:
    states are checked here, and `said` gives back what was printed.
    """

    def __init__(self, interpreter: str):
        self._print = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")
        self._process = subprocess.Popen(
            [interpreter, str(_PROGRAM)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._print, text=True,
        )  # fmt: skip

    def __enter__(self) -> "Siconos":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(timeout=60)
        self._print.close()

    def build(self, law: ContactLaw, h: float, theta: float, t1: float) -> None:
        letters = {name: getattr(law, name) for name in _LETTERS}
        self._ask(do="build", law=letters, g=law.g.tolist(), h=h, theta=theta, t1=t1)

    def advance(self, steps: int) -> float:
        """Seconds for that many steps."""
        return self._ask(do="advance", steps=steps)["seconds"]

    def state(self) -> np.ndarray:
        """x now.

        **Raises:** `RuntimeError` where an entry is not finite.
        """
        x = np.array(self._ask(do="state")["x"])
        bad = np.flatnonzero(~np.isfinite(x))
        if bad.size:
            raise RuntimeError(
                f"Siconos returned {x[bad[0]]} at point {bad[0]} without reporting a failure: its "
                "times are not those of a solution"
            )
        return x

    def said(self) -> str:
        """What Siconos has printed so far."""
        self._print.seek(0)
        return self._print.read().strip()

    def _ask(self, **order: Any) -> dict[str, Any]:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"Siconos ended while asked to {order['do']}: {self.said()[-2000:]}")
        return json.loads(line)
