"""The error budget: steps above the tolerance that are accepted all the same."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from .error_test import Attempt

_SHARE = 1e-6
"""Share of the remaining budget that one step may use: small, since the derivative of a step over an
unlocated kink is that of one side of it."""

_LARGE_SHARE = 0.1
"""The same where no smaller step is better."""

_EXHAUSTED = 1e-3
"""Remaining budget below which roundoff may use no more of it."""

_MAX_CROSSINGS = 4
"""Consecutive steps of the smallest size that may exceed the tolerance and the budget."""


class ErrorBudget(NamedTuple):
    """The budget for steps over kinks and jumps.

    A kink or an unannounced jump inside a step has a defect that does not decrease with the step size
    h; the integrated defect does, as h. Such steps have the tolerance of the run once more among
    them: `remaining` starts at 1, and each step may use a small share of what remains. `crossings`
    counts consecutive steps of the smallest size that exceeded both: the time of a jump is uncertain
    by the rounding of t, and no smaller step resolves it.
    """

    remaining: Any
    crossings: Any

    @staticmethod
    def at_start(like: Any) -> "ErrorBudget":
        return ErrorBudget(jnp.ones_like(like), jnp.asarray(0))

    def covers(self, attempt: Attempt, is_noise: Any) -> Any:
        """Return whether the step may use the budget."""
        large = (attempt.size <= 1e4 * attempt.smallest) | is_noise
        share = jnp.where(large, _LARGE_SHARE, _SHARE)
        return attempt.integrated <= share * self.remaining

    def may_cross(self, attempt: Attempt, is_resolved: Any, unenclosed: Any) -> Any:
        """Return whether the step may cross a jump whatever its error, which is infinite where the
        defect is `unenclosed`; `is_resolved` says whether steps of this size are small against the
        run."""
        smallest = is_resolved & (attempt.size <= 4.0 * attempt.smallest)
        is_known = jnp.isfinite(attempt.error) | unenclosed
        return smallest & (self.crossings < _MAX_CROSSINGS) & is_known

    def is_exhausted(self) -> Any:
        return self.remaining < _EXHAUSTED

    def after(
        self, attempt: Attempt, accepted: Any, covered: Any, is_roundoff: Any
    ) -> "ErrorBudget":
        """Return the budget after an attempt. Roundoff that no step size reduces is not charged, and
        no infinite defect: the step is one of the `crossings`."""
        above = (attempt.error > 1.0) & jnp.isfinite(attempt.integrated)
        left = jnp.maximum(self.remaining - attempt.integrated, 0.0)
        remaining = jnp.where(accepted & above & ~is_roundoff, left, self.remaining)
        crossed = jnp.where(
            accepted & ~covered & (attempt.error > 1.0), self.crossings + 1, self.crossings
        )
        onward = accepted & (attempt.error <= 1.0) & (attempt.size > 16.0 * attempt.smallest)
        return ErrorBudget(remaining, jnp.where(onward, 0, crossed))
