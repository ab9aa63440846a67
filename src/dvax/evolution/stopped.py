"""Where a run stopped, and what a search for the cause returns."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import Fix
from .flow import Flow
from .setup import Setup

LAST_STEPS = 64.0
"""Steps ahead of the last state in which a cause is looked for."""


class Diagnosis(NamedTuple):
    """The cause in a sentence or two ("" where there is no evidence), and what helps."""

    cause: str = ""
    fixes: tuple[Fix, ...] = ()
    whole: bool = False
    """Whether the cause says what happened, too."""


class Stop(NamedTuple):
    """Where a run stopped, with all that the tests of causes need."""

    setup: Setup
    flow: Flow
    t: float
    x: Tree
    step: float
    steps: int
    attempts: int

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
        """x' = Ax + f̃(t, x)."""
        return _tree.add(self.flow.generator.apply(x), self.flow.rate(t, x, None).value)

    def norm(self, x: Tree) -> float:
        return float(self.flow.state_space(self.x).norm(x))
