"""Single members of an ensemble: their runs, and what is wrong with their data."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax

from ..errors import InputError
from ..evolution import Solution, solve
from ..evolution.nonfinite import first_bad
from ..problem import Problem
from .inputs import Inputs


@dataclasses.dataclass(frozen=True, eq=False)
class Alone:
    """The members of an ensemble, one at a time, with the options of its call."""

    problem: Problem
    inputs: Inputs
    options: Mapping[str, Any]

    def solve(self, k: int) -> Solution:
        """Solve member k.

        **Raises:** as `dvax.solve` does.
        """
        x0, args, t0, t1, ts = self.inputs.member(k)
        return solve(self.problem, x0, t0, t1, args, ts, **self.options)

    def invalid_data(self, times: Mapping[int, float]) -> dict[int, str]:
        """Return what is wrong with x0, args, or K at the given time, by the number of the
        member; members whose data are valid are absent."""
        found = {k: text for k in times if (text := self._nonfinite(k))}
        return found | self._empty({k: t for k, t in times.items() if k not in found})

    def _nonfinite(self, k: int) -> str:
        x0, args, *_ = self.inputs.member(k)
        if text := first_bad(x0):
            return f"Its x0 is {text}."
        text = first_bad(args, allow_infinite=True)
        return f"Its args contain {text}." if text else ""

    def _empty(self, times: Mapping[int, float]) -> dict[int, str]:
        found: dict[int, str] = {}
        for k, t in times.items():
            x0, args, *_ = self.inputs.member(k)
            at = f"at t = {t:.10g}"
            try:
                self.problem.set_at(t, args)
                if first_bad(self._nearest(t, x0, args)):
                    found[k] = f"K is empty {at}."
            except InputError as refused:
                first = refused.problems[0]
                found[k] = f"K is refused {at}: {first.place}: got {first.given}; {first.rule}."
        return found

    @functools.cached_property
    def _nearest(self) -> Any:
        """The point of K(t) nearest to 0 as a compiled function of (t, x0, args)."""
        problem = self.problem

        def nearest(t: Any, x0: Any, args: Any) -> Any:
            space = problem.spaces(x0)[1]
            return problem.set_at(t, args).project(problem.zero_control(x0), space)

        return jax.jit(nearest)
