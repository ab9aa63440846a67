"""A problem with its initial state, duration, names and units, for the command line."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._dataset import named
from .._tree import Tree
from ..errors import Problems
from ..evolution import Solution
from ..problem import Problem
from ..theory import Constants


@dataclasses.dataclass(frozen=True)
class Model:
    """A problem, where it starts, how long it runs, and names and units for its states and responses.

    A function that returns one is a model of the command line: `[model] python = "file.py:build"`.

    - `problem`, `x0`, `args`: as in `dvax.solve`; `t0`, `t_end`: first and last time, in `time_unit`;
    - `states`: a name for each entry of x with its unit, or for each part of a tuple, such as
      {"position": "m", "velocity": "m/s"}; `responses`: the same for u;
    - `constants`: proved or declared `dvax.Constants`, by default those of `dvax.verify`;
    - `settings`: options of `dvax.solve`, such as {"rtol": 1e-8}: method, rtol, atol, dt, dt_max,
      max_steps, vi_solver;
    - `figures`: a function of the `dvax.Solution` to numbers for the summary, by name: (value, unit,
      meaning).

    **Raises:** `dvax.InputError` if the names do not fit.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> model = dvax.models.Model(problem, -1.0, 2.0, states={"depth": "mm"}, responses={"force": "N"})
    >>> model.time_unit
    's'

    ```
    """

    problem: Problem
    x0: Tree
    t_end: float
    t0: float = 0.0
    args: Any = None
    states: Mapping[str, str] = dataclasses.field(default_factory=dict)
    responses: Mapping[str, str] = dataclasses.field(default_factory=dict)
    time_unit: str = "s"
    title: str = ""
    constants: Constants | None = None
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    figures: Callable[[Solution], Mapping[str, tuple[Any, str, str]]] | None = None

    def __post_init__(self) -> None:
        _tree.check_kind(
            self.problem, Problem, "dvax.models.Model(problem)", "it must be a dvax.Problem",
            "Build one with dvax.Problem(A=…, P=…, K=…, f=…, h=…)",
        )  # fmt: skip
        object.__setattr__(self, "x0", _tree.as_float(self.x0, "x0"))
        wrong = Problems()
        for name in ("states", "responses", "settings"):
            value = getattr(self, name)
            if not isinstance(value, Mapping):
                wrong.add(
                    f"dvax.models.Model({name})", _tree.line(value), "it must be a dictionary",
                    'Write states={"position": "m"}, say',
                )  # fmt: skip
        if not (self.constants is None or isinstance(self.constants, Constants)):
            wrong.add(
                "dvax.models.Model(constants)", _tree.line(self.constants),
                "they must be dvax.Constants", "Leave them out for those of dvax.verify",
            )  # fmt: skip
        wrong.raise_any()
        for name in self.settings:
            if name not in _SETTINGS:
                wrong.add(
                    f"dvax.models.Model(settings[{name!r}])", _tree.line(self.settings[name]),
                    f"a run has the options {', '.join(_SETTINGS)}", "Leave it out",
                )  # fmt: skip
        names = [*self.states, *self.responses]
        for name in dict.fromkeys(names):
            if name in _RESERVED or names.count(name) > 1:
                why = "is of the results already" if name in _RESERVED else "stands for two of them"
                wrong.add(
                    "dvax.models.Model(states, responses)", repr(name), f"this name {why}",
                    "Choose another one",
                )  # fmt: skip
        for name, t in (("t0", self.t0), ("t_end", self.t_end)):
            if not (_tree.is_number(t) and np.isfinite(t)):
                wrong.add(
                    f"dvax.models.Model({name})", _tree.line(t), "it must be a finite number",
                    "Write a number such as 2.0",
                )  # fmt: skip
        wrong.raise_any()
        if not self.t0 < self.t_end:
            wrong.add(
                "dvax.models.Model(t0, t_end)", f"{self.t0}, {self.t_end}", "t0 < t_end",
                "Swap or correct them",
            )  # fmt: skip
        elements = {"states": self.x0, "responses": self.problem.zero_control(self.x0)}
        for which, element in elements.items():
            names = getattr(self, which)
            parts, entries = _counts(element)
            if names and len(names) not in (parts, entries):
                of, source = ("x0", "x0") if which == "states" else ("u", "the control space")
                wrong.add(
                    f"dvax.models.Model({which})",
                    f"{len(names)} name{'' if len(names) == 1 else 's'}: {', '.join(names)}",
                    f"it needs a name for each of the {entries} entries of {of}"
                    + (f", or for each of its {parts} parts" if 1 < parts < entries else ""),
                    f"Add or remove names, or correct {source}",
                )  # fmt: skip
        wrong.raise_any()

    def series(self, which: str, rows: Tree) -> dict[str, tuple[np.ndarray, str]]:
        """Return values and unit of each named entry or part of `rows`, those of the "states" or the
        "responses" at the saved times, a time axis in front."""
        names: Mapping[str, str] = getattr(self, which)
        symbol = "x" if which == "states" else "u"
        if not names:
            element = self.x0 if which == "states" else self.problem.zero_control(self.x0)
            parts, entries = _counts(element)
            count = entries if entries <= _NAMED else parts
            names = {symbol if count == 1 else f"{symbol}{k}": "" for k in range(count)}
        found = named(rows, names, symbol, f"dvax.models.Model({which})")
        return {name: (np.asarray(values), unit or "") for name, (values, unit) in found.items()}


_SETTINGS = ("method", "rtol", "atol", "dt", "dt_max", "max_steps", "vi_solver")
_RESERVED = ("time", "error_bound")

_NAMED = 12
"""Up to this many entries without names are numbered one by one."""


def _counts(element: Tree) -> tuple[int, int]:
    """Return the numbers of parts and of entries."""
    leaves = jtu.tree_leaves(element)
    return len(leaves), sum(np.size(leaf) for leaf in leaves)
