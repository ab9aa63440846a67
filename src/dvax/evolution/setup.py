"""The arguments of a solve: `Setup`, and the static `Options` of its loop."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..problem import Problem
from ..vi import AbstractSolver
from .event import Event


class Setup(NamedTuple):
    """The arguments that determine the solution.

    - `setting`: the numbers t0, t1, dt (NaN for adaptive steps), rtol, atol, dt0, dt_max and horizon,
      and the `stiff_steps` of the stiffness guard;
    - `moduli`: γ, L_F, ‖P⁻¹‖ and β_f‖P⁻¹‖, as far as they are given;
    - `method`: an `AbstractMethod`, `Implicit`, `Picard` or `PiecewiseLinear`;
    - `events`: of the user.

    It is a plain tuple, since every call makes one.
    """

    problem: Problem
    x0: Tree
    args: Any
    setting: dict[str, Any]
    method: Any
    vi_solver: AbstractSolver
    moduli: dict[str, Any]
    events: tuple[Event, ...] = ()

    @property
    def dtype(self) -> Any:
        """The floating-point type of the state and of time."""
        return _tree.dtype(self.x0)

    def number(self, name: str) -> jax.Array:
        """Return an entry of `setting` in the type of the state."""
        return jnp.asarray(self.setting[name], self.dtype)

    def is_valid(self, ts: Any) -> jax.Array:
        """Return whether the numbers obey the rules of `arguments.check`, which skips traced ones."""
        number = self.number
        lengths = jnp.stack([number(name) for name in ("dt0", "dt_max", "horizon")])
        # dt is NaN where steps adapt.
        positive = jnp.all(lengths > 0) & ~(number("dt") <= 0)
        rtol, atol = number("rtol"), number("atol")
        tolerances = (rtol >= 0) & (atol >= 0) & (rtol + atol > 0)
        is_forward = number("t1") > number("t0")
        if ts is not None:
            is_forward &= jnp.min(jnp.asarray(ts, self.dtype)) >= number("t0")
        return is_forward & positive & tolerances


class Options(NamedTuple):
    """Static options of a time loop; see `dvax.solve`."""

    fixed: bool
    measure: bool
    track_bounds: bool
    check_finite: bool
    dense: bool
    max_steps: int
    adjoint: str
    progress: bool
    watch_stiffness: bool = False
    max_events: int = 0


def pack(setting: dict[str, Any]) -> Any:
    """Return a setting as one vector if its entries are Python floats: each argument of a compiled
    program costs 1.5 µs a call."""
    entries = list(setting.values())
    return np.array(entries) if all(type(entry) is float for entry in entries) else entries


def unpack(entries: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the setting with these entries."""
    return dict(zip(names, entries, strict=True))
