"""Fixed steps."""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ... import _tree
from ..results import RESULTS
from .controller import AbstractController, StepDecision

_ROUNDINGS = 4.0
"""Roundings of the ends of an interval, by which it may be longer than a number of steps."""


class Fixed(AbstractController):
    """Equal steps no longer than dt between one stop and the next."""

    stops: jax.Array
    dt: Any

    adapts: ClassVar[bool] = False

    class State(NamedTuple):
        """The number of the segment between two stops, and of the step within it (from 1)."""

        segment: Any
        step: Any

    def init(self):
        return self.State(jnp.asarray(0), jnp.asarray(1))

    def end(self, state):
        return self._time(state.segment, state.step)

    def next_size(self, state):
        return self.dt

    def decide(self, t0, t1, x0, step, state):
        if self.stops.shape[0] == 2:
            new, jumped = self.State(state.segment, state.step + 1), jnp.asarray(False)
        else:
            last = self.stops.shape[0] - 2
            jumped = state.step >= self._counts()[state.segment]
            segment = jnp.minimum(state.segment + jnp.where(jumped, 1, 0), last)
            new = self.State(segment, jnp.where(jumped, 1, state.step + 1))
        # Where the defect is measured, `step.finite` covers the start of the step alone.
        finite = step.finite if step.error is None else step.finite & _tree.all_finite(step.x1)
        result = RESULTS.where(step.solved, RESULTS.successful, RESULTS.law_unsolved)
        result = RESULTS.where(finite, result, RESULTS.nonfinite)
        return StepDecision(step.solved & finite, new, jumped, result)

    def step_start(self, index, t):
        if self.stops.shape[0] == 2:
            return self._time(0, index)
        counts = self._counts()
        # The number of steps up to the end of each segment. A sum of products instead of `cumsum`,
        # for few segments: XLA compiles it into the loop (`_jax.outlined`).
        if len(counts) <= 32:
            upto = jnp.sum(np.tri(len(counts), dtype=int) * counts[None], axis=1)
            segment = jnp.sum(upto <= index)
        else:
            upto = jnp.cumsum(counts)
            segment = jnp.searchsorted(upto, index, side="right")
        segment = jnp.minimum(segment, len(counts) - 1)
        before = jnp.where(segment > 0, upto[segment - 1], 0)
        return self._time(segment, index - before)

    def _counts(self) -> Any:
        return step_count(self.stops[:-1], self.stops[1:], self.dt).astype(int)

    def _time(self, segment: Any, step: Any) -> Any:
        left, right = self.stops[segment], self.stops[segment + 1]
        count, step = step_count(left, right, self.dt), jnp.asarray(step, left.dtype)
        # The last end is the stop itself: a sum may round past it.
        return jnp.where(step >= count, right, left + step * ((right - left) / count))


def step_count(left: Any, right: Any, dt: Any) -> Any:
    """Return the least number of equal steps no longer than dt that fill the time from left to right,
    up to the rounding of these times and of dt."""
    span, eps = right - left, jnp.finfo(jnp.result_type(left)).eps
    rounding = _ROUNDINGS * eps * (span + jnp.maximum(jnp.abs(left), jnp.abs(right)))
    # Near the resolution of t the steps are what they are.
    span = jnp.maximum(span - rounding, 0.5 * span)
    return jnp.maximum(jnp.ceil(span / dt), 1.0)
