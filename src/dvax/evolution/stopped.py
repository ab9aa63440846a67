"""The last state of a failed run (`Stop`), and the result of a test for a cause (`Diagnosis`)."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import Fix
from .flow import Flow
from .setup import Setup

LAST_STEPS = 64.0
"""Number of steps after the last state that the search for a cause covers."""


class Diagnosis(NamedTuple):
    """A cause in one or two sentences ("" if there is no evidence), and fixes.

    If `replaces_result`, the cause also says what happened, so that the error omits the text of the
    result. `is_nonfinite`: f or h is NaN or infinite, whatever the result is.
    """

    cause: str = ""
    fixes: tuple[Fix, ...] = ()
    replaces_result: bool = False
    is_nonfinite: bool = False


class Stop(NamedTuple):
    """The last state of a failed run, as the tests for causes need it.

    `step` is the next step size, `steps` the number of accepted steps, and `attempts` the number of
    accepted and rejected ones; `is_method_named` says that the caller named the method.
    """

    setup: Setup
    flow: Flow
    t: float
    x: Tree
    step: float
    steps: int
    attempts: int
    is_method_named: bool

    @property
    def span(self) -> tuple[float, float]:
        return float(self.setup.setting["t0"]), float(self.setup.setting["t1"])

    @property
    def ulp(self) -> float:
        """The spacing of floating-point numbers at t, in the precision of the state."""
        return float(jnp.finfo(self.setup.dtype).eps) * abs(self.t)

    def time(self, t: float) -> jax.Array:
        return jnp.asarray(t, self.setup.dtype)

    def velocity(self, t: Any, x: Tree) -> Tree:
        """Return x' = Ax + f̃(t, x)."""
        return _tree.add(self.flow.generator.apply(x), self.flow.rate(t, x, None).value)

    def norm(self, x: Tree) -> float:
        return float(self.flow.state_space(self.x).norm(x))
