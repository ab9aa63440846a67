"""The tangent limit: steps that a derivative of the run can take, whatever the state does."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from ..stepper import Fastest
from .error_test import Attempt

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

_AT_REST, _ROUNDINGS = 1e-8, 100.0
"""Error, in tolerances and in roundings of x, below which the state is taken to be at rest."""

_LARGEST_DECAY = 40.0
"""Decay D up to which is counted: e^−40 is below any tolerance."""

_COUNTED_AT_REST = 0.1
"""Share of z that counts in D at rest: slower solutions, which may grow, are resolved by nothing else
there."""

_COUNTED_OF_REST = 0.5
"""Share of the decay of what remains that counts: the slope of a direction that contains faster
solutions is larger than that of the slowest."""

_CROSSING = 10.0
"""Largest z of a step over a kink, in errors of a tangent: the state is continuous there, and does not
show that the slope is wrong in a part of the step."""

_FINEST = 1e-4
"""Step size, as a share of the run, down to which a change of B within a step is resolved: one that no
step resolves is the rounding of a state on a kink."""


class StepLimit(NamedTuple):
    """The `longest` next step; whether the present one `is_short_enough`, and so short that it
    `may_cross` a kink; and whether the slope chooses the steps while x stands still (`is_stiff`)."""

    longest: Any
    is_short_enough: Any
    may_cross: Any
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
    What has not decayed (`power_iteration.remaining`) has a limit of its own, with its slope and a D of
    its own: 0 for an oscillation, and half of its decay where it ends too.
    Where the state stands still, a B that varies in time as e^{iωt} is resolved as well: with z the
    smaller of hω and hω (Tσ)^{1/p}, T being the `span` of the run. So is a forcing by parameters with
    hω, always: nothing of it is in x where its amplitude is zero.

    `order` is p, `stable` the limit of stability on the negative axis; `is_exact` for a method that
    linearises, whose B is the change of f̃' since the start of the step.
    """

    rtol: Any
    span: Any
    order: int = eqx.field(static=True)
    stable: float = eqx.field(static=True)
    is_exact: bool = eqx.field(static=True, default=False)

    def of(self, fastest: Fastest, decay: Any, attempt: Attempt) -> StepLimit:
        """Return the limit after an attempt, where `decay` are the two D."""
        slope, variation, forcing, remaining, kink, is_damped, ends, is_stiff = lax.stop_gradient(
            fastest
        )
        size, smallest = attempt.size, attempt.smallest
        error = _SHARE * jnp.maximum(self.rtol, jnp.finfo(size.dtype).eps)
        resolved = (math.factorial(self.order + 1) * error) ** (1.0 / self.order)
        accurate, of_rest = resolved * jnp.exp(decay / self.order)
        stable = _STABLE * self.stable
        most = jnp.minimum(accurate, jnp.where(is_damped, stable, _LARGEST_TURN))
        of_rest = jnp.minimum(of_rest, jnp.where(ends, stable, _LARGEST_TURN))
        # The change of f̃' over a step, and the step, are proportional to h.
        of_slope = _share(most, slope) ** (0.5 if self.is_exact else 1.0)
        of_slope = jnp.minimum(of_slope, _share(of_rest, remaining))
        variation = variation * jnp.minimum(slope * self.span / size, 1.0) ** (1.0 / self.order)
        of_change = jnp.where(self._is_at_rest(attempt.error), _share(accurate, variation), jnp.inf)
        of_change = jnp.minimum(of_change, _share(resolved, forcing))
        if self.is_exact:
            of_change, of_slope = jnp.minimum(of_slope, of_change), jnp.full_like(slope, jnp.inf)
        finest = _FINEST * self.span
        # Twice the finest one, so that a step that is cut to it passes.
        resolves = (_SLACK * of_change >= 1.0) | (size <= 2.0 * finest)
        is_stable = (_SLACK * of_slope >= 1.0) | (size <= 2.0 * smallest)
        return StepLimit(
            longest=jnp.minimum(
                _AIM * size * of_slope, jnp.maximum(_AIM * size * of_change, finest)
            ),
            is_short_enough=resolves & is_stable,
            may_cross=kink <= _CROSSING * error,
            is_stiff=is_stiff & (slope > _BINDS * most),
        )

    def after(
        self, fastest: Fastest, decay: Any, error: Any, accepted: Any, is_excited: Any
    ) -> Any:
        """Return D of the fastest solutions and of what remains after an attempt with this error in
        tolerances. Events and jumps of the data excite what has decayed (`is_excited`), and nothing is
        counted where the solutions do not decay."""
        fastest = lax.stop_gradient(fastest)
        slope, remaining = fastest.slope, fastest.remaining
        of_fastest = jnp.where(self._is_at_rest(error), _COUNTED_AT_REST * slope, slope)
        # The direction of what remains is that of solutions which decay for 1/σ in a step at most.
        of_rest = _COUNTED_OF_REST * remaining / jnp.maximum(slope, 1.0)
        added = jnp.where(accepted, jnp.stack([of_fastest, of_rest]), 0.0)
        decays = jnp.stack([fastest.is_damped, fastest.ends]) & ~is_excited
        return jnp.where(decays, jnp.minimum(decay + added, _LARGEST_DECAY), 0.0)

    def _is_at_rest(self, error: Any) -> Any:
        """Return whether the state stands still, by the error of a step in tolerances."""
        rounding = jnp.finfo(jnp.result_type(error)).eps / self.rtol
        return error < jnp.maximum(_AT_REST, _ROUNDINGS * rounding)


def _share(most: Any, z: Any) -> Any:
    """Return most/z, ∞ for z = 0."""
    return jnp.where(z > 0.0, most / jnp.where(z > 0.0, z, 1.0), jnp.inf)
