"""The arguments of a solve."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..problem import Problem
from ..vi import AbstractSolver


class Setup(NamedTuple):
    """The arguments of a solve that its solution is a function of.

    `setting` holds the numbers: t0, t1, dt (NaN for adaptive steps), rtol, atol, dt0, horizon;
    `moduli` those of γ, L_F and ‖P⁻¹‖ that are known; `method` is an `AbstractMethod`, `Implicit`,
    `Picard` or `PiecewiseLinear`, which all take a setup. A plain tuple: one is made at every call.
    """

    problem: Problem
    x0: Tree
    args: Any
    setting: dict[str, Any]
    method: Any
    vi_solver: AbstractSolver
    moduli: dict[str, Any]

    @property
    def dtype(self) -> Any:
        """The floating type of the state, which time shares."""
        return jnp.result_type(*jtu.tree_leaves(self.x0))

    def number(self, name: str) -> jax.Array:
        """An entry of `setting`, in the type of the state."""
        return jnp.asarray(self.setting[name], self.dtype)

    def is_valid(self, ts: Any) -> jax.Array:
        """Whether the numbers obey the rules of `arguments.check`, which cannot look at traced ones."""
        number = self.number
        lengths = jnp.stack([number(name) for name in ("dt0", "dt_max", "horizon")])
        # dt is NaN where steps adapt.
        positive = jnp.all(lengths > 0) & ~(number("dt") <= 0)
        rtol, atol = number("rtol"), number("atol")
        tolerances = (rtol >= 0) & (atol >= 0) & (rtol + atol > 0)
        forward = number("t1") > number("t0")
        if ts is not None:
            forward &= jnp.min(jnp.asarray(ts, self.dtype)) >= number("t0")
        return forward & positive & tolerances


class Options(NamedTuple):
    """What a time loop is compiled for, apart from shapes; see `dvax.solve`."""

    fixed: bool
    measure: bool
    track_bounds: bool
    check_finite: bool
    dense: bool
    max_steps: int
    adjoint: str
    progress: bool
    stiff_steps: int | None = None


def as_arrays(args: Any) -> Any:
    """Return args with Python floats as the arrays that f and h always get; integers and flags stay
    what they are."""
    return jtu.tree_map(lambda v: jnp.asarray(v) if isinstance(v, float) else v, args)
