"""Where steps end: on the knots of data, and where the defect allows."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
from jax import lax

from .._tree import Tree
from ..spaces import AbstractSpace, Product


class Adaptive(diffrax.AbstractStepSizeController):
    """Steps as long as the defect stays below (atol + rtol‖x‖)/horizon.

    ‖·‖ is the root mean square in the state space, taken part by part where the state is a tuple, so
    that parts with different units are each held to their own size. Entry by entry it is not: where
    an entry passes through zero, nothing asks for a better rate there.

    The defect integrated over the run is then at most the tolerance, so the computed trajectory is
    the exact one of a system disturbed by no more than was asked for. A kink or an unannounced jump
    inside a step has a defect that does not shrink with h; its impulse h·defect does, and a share of
    the tolerance is set aside for such steps, each spending at most a small part of what is left.

    A length is kept while it is within a fifth of the best one, since a new length costs new
    φ-functions; and the rest of the way to a knot is cut into equal parts, never into a sliver.
    """

    rtol: Any
    atol: Any
    sizes: Callable[[Tree], list[Any]]
    horizon: Any
    knots: Any
    end: Any

    class State(NamedTuple):
        length: Any
        knot: Any
        rejected: Any
        spare: Any

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        first = jnp.asarray(0)
        state = self.State(dt0, first, jnp.asarray(False), jnp.ones_like(dt0))
        return _land(t0, dt0, self._stop(first)), state

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        state = controller_state
        t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
        h = t1 - t0
        assert y_error is not None  # the stepper always measures where steps adapt
        # Where a step ends is a choice, not a function of the data: derivatives see the steps as given.
        error = lax.stop_gradient(self.horizon * self._scaled(y_error.x, y0.x, y1_candidate.x))
        impulse = error * h / self.horizon
        # A small share, because a derivative loses a kink's step; a large one where t has no room.
        floor = 8 * jnp.finfo(h.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
        share = jnp.where(h <= 1e4 * floor, 0.1, 1e-6)
        relaxed = state.rejected & (impulse <= share * state.spare)
        keep = (error <= 1.0) | relaxed
        spare = jnp.where(keep & (error > 1.0), state.spare - impulse, state.spare)

        positive = jnp.where(error > 0.0, error, 1.0)
        factor = jnp.where(error > 0.0, (0.5 / positive) ** (1.0 / error_order), jnp.inf)
        factor = jnp.clip(factor, 0.1, 3.0)
        steady = keep & (factor > 0.8) & (factor < 1.25)
        length = lax.stop_gradient(h)
        wanted = jnp.where(steady, length, length * factor)
        # A step cut short by a knot says little about the length that was planned.
        cut = keep & (h < 0.99 * state.length)
        wanted = jnp.where(
            cut, jnp.maximum(wanted, jnp.minimum(state.length, 3.0 * wanted)), wanted
        )

        on_knot = keep & (t1 == self._stop(state.knot))
        knot = jnp.where(on_knot, state.knot + 1, state.knot)
        start = jnp.where(keep, t1, t0)
        next_t1 = _land(start, wanted, self._stop(knot))
        # Below this, t itself cannot tell the ends of a step apart.
        stuck = ~keep & (h <= floor)
        blocked = diffrax.RESULTS.where(
            jnp.isfinite(error),
            diffrax.RESULTS.dt_min_reached,
            diffrax.RESULTS.nonfinite,
        )
        result = diffrax.RESULTS.where(stuck, blocked, diffrax.RESULTS.successful)
        new = self.State(wanted, knot, ~keep, spare)
        return keep, start, next_t1, on_knot, new, result

    def _scaled(self, error: Tree, before: Tree, after: Tree) -> Any:
        parts = zip(self.sizes(error), self.sizes(before), self.sizes(after), strict=True)
        ratios = [e / (self.atol + self.rtol * jnp.maximum(a, b)) for e, a, b in parts]
        ratio = jnp.max(jnp.stack(ratios)) if len(ratios) > 1 else ratios[0]
        # What is not a number is no reason to accept, nor to lengthen.
        return jnp.where(jnp.isnan(ratio), jnp.inf, ratio)

    def _stop(self, knot: Any) -> Any:
        if self.knots.shape[0] == 0:
            return self.end
        inner = self.knots[jnp.minimum(knot, self.knots.shape[0] - 1)]
        return jnp.where(knot < self.knots.shape[0], inner, self.end)


def _land(t: Any, length: Any, until: Any) -> Any:
    """The end of a step from t: `until` itself when in reach, half way when one step nearly is."""
    rest = until - t
    reaches = length >= rest * (1 - 1e-9)
    return jnp.where(reaches, until, t + jnp.where(2 * length > rest, 0.5 * rest, length))


class Fixed(diffrax.AbstractStepSizeController):
    """Equal steps no longer than dt between one stop (knot or end) and the next."""

    dt: Any
    stops: Any

    class State(NamedTuple):
        segment: Any
        step: Any

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        state = self.State(jnp.asarray(0), jnp.asarray(1))
        return self._time(state), state

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        state = controller_state
        if self.stops.shape[0] == 2:
            new, jump = self.State(state.segment, state.step + 1), False
        else:
            last = self.stops.shape[0] - 2
            finished = state.step >= self._count(state.segment)
            segment = jnp.minimum(state.segment + jnp.where(finished, 1, 0), last)
            new = self.State(segment, jnp.where(finished, 1, state.step + 1))
            jump = finished
        return True, t1, self._time(new), jump, new, diffrax.RESULTS.successful

    def _count(self, segment: Any) -> Any:
        return step_count(self.stops[segment + 1] - self.stops[segment], self.dt)

    def _time(self, state: "Fixed.State") -> Any:
        left, right = self.stops[state.segment], self.stops[state.segment + 1]
        count = self._count(state.segment)
        # The last one is the stop itself, not a sum that rounds past it.
        inner = left + state.step * ((right - left) / count)
        return jnp.where(state.step >= count, right, inner)


def step_count(span: Any, dt: Any) -> Any:
    """The fewest equal steps no longer than dt (up to rounding) that fill the span."""
    return jnp.maximum(jnp.ceil(span / dt * (1 - 1e-12)), 1.0)


def root_mean_squares(space: AbstractSpace) -> Callable[[Tree], list[Any]]:
    """The root mean square of each part of a state: its norm divided by that of the constant 1."""
    if isinstance(space, Product):
        spaces = space.spaces
        return lambda tree: [_mean(s, p) for s, p in zip(spaces, tree, strict=True)]
    return lambda tree: [_mean(space, tree)]


def _mean(space: AbstractSpace, part: Tree) -> Any:
    norm = space.norm(part)
    return norm / jnp.sqrt(space.size()).astype(norm.dtype)
