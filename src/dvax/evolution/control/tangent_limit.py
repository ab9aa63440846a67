"""The tangent limit: steps that a derivative of the run can take, whatever the state does."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from ..stepper import Fastest

_SHARE = 10.0
"""Error of a tangent within the time 1/σ, relative to it and in tolerances."""

_STABLE = 0.8
"""Share of the limit of stability that steps may reach: σ is an estimate from below."""

_AIM = 0.8
"""Share of the limit at which new steps aim, so that they may stay as they are nearby."""

_LARGEST_TURN = 1.0
"""Largest z of solutions that do not decay: beyond it the explicit methods let oscillations grow."""

_SLACK = 2.0
"""Factor by which a step may be too long: at a kink the slope changes between two steps."""

_BINDS = 0.5
"""Share of the limit from which the slope is taken to choose the steps."""

_AT_REST = 1e-8
"""Error, in tolerances, below which the state is taken to be at rest."""

_LARGEST_DECAY = 40.0
"""Decay D up to which is counted: e^−40 is below any tolerance."""


class StepLimit(NamedTuple):
    """The `longest` next step; whether the present one `is_short_enough`; and whether the slope chooses
    the steps while x stands still (`is_stiff`)."""

    longest: Any
    is_short_enough: Any
    is_stiff: Any

    def limit(self, size: Any, present: Any) -> Any:
        """Return the next step size, which was to be `size` after the `present` one. One that is within
        a fifth of `longest` stays as it is: a new size costs new φ-functions."""
        near = (self.longest > _AIM * present) & (_AIM * self.longest < present)
        steady = near & (size >= present)
        return jnp.where(steady, present, jnp.minimum(size, self.longest))


class TangentLimit(eqx.Module):
    """Limit the steps by the largest slope σ of what the method treats explicitly.

    In a step with z = hσ a method of order p misses a part z^{p+1}/(p+1)! of the fastest solutions of
    v' = Bv, and 1/z times as much within the time 1/σ. If they have decayed by e^{−D} since they were
    last excited, e^{−D} times this may be 10 rtol, so that

        z ≤ ((p+1)! 10 rtol e^D)^{1/p},   D = Σ z over the steps since then,

    up to the limit of stability of the method, or up to 1 where the fastest solutions do not decay.
    `order` is p, `stable` the limit of stability on the negative axis.
    """

    rtol: Any
    order: int = eqx.field(static=True)
    stable: float = eqx.field(static=True)

    def of(self, fastest: Fastest, decay: Any, size: Any, smallest: Any) -> StepLimit:
        """Return the limit after a step of this size, where `decay` is D."""
        slope, is_damped, is_stiff = lax.stop_gradient(fastest)
        error = _SHARE * jnp.maximum(self.rtol, jnp.finfo(size.dtype).eps)
        accurate = (math.factorial(self.order + 1) * error) ** (1.0 / self.order)
        most = jnp.minimum(
            accurate * jnp.exp(decay / self.order),
            jnp.where(is_damped, _STABLE * self.stable, _LARGEST_TURN),
        )
        longest = _AIM * size * (most / jnp.where(slope > 0.0, slope, 1.0))
        return StepLimit(
            longest=jnp.where(slope > 0.0, longest, jnp.inf),
            is_short_enough=(slope <= _SLACK * most) | (size <= 2.0 * smallest),
            is_stiff=is_stiff & (slope > _BINDS * most),
        )

    def after(
        self, fastest: Fastest, decay: Any, error: Any, accepted: Any, is_excited: Any
    ) -> Any:
        """Return D after an attempt with this error in tolerances. Events and jumps of the data excite
        what has decayed (`is_excited`), and nothing is counted where the fastest solutions do not
        decay. At rest a tenth is: slower solutions, which may grow, are then resolved by nothing
        else."""
        slope, is_damped, _ = lax.stop_gradient(fastest)
        added = jnp.where(error < _AT_REST, 0.1 * slope, slope)
        counted = jnp.minimum(decay + jnp.where(accepted, added, 0.0), _LARGEST_DECAY)
        return jnp.where(is_excited | ~is_damped, 0.0, counted)
