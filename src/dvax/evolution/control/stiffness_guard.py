"""The stiffness guard: steps whose size stability limits, and not accuracy."""

from typing import Any, NamedTuple

import jax.numpy as jnp

_LIMIT = 0.3
"""h times the slope of f̃ above which a step may be limited by stability: the methods are stable up to 2
to 3.3 on the negative axis, and the error test keeps them a few times below that."""

_VOTES, _CLEAR = 15, 6
"""Accepted steps above the limit that end the run; consecutive steps below it that reset the count."""


class StiffnessGuard(NamedTuple):
    """Count accepted steps that stability limits.

    The slope is ‖Δf̃‖/‖Δx‖ between two stages at one time (Hairer and Wanner 1996, Section IV.2). A step
    without a difference of stages, or over a kink, does not count either way.
    """

    votes: Any
    clear: Any

    @staticmethod
    def at_start() -> "StiffnessGuard":
        return StiffnessGuard(jnp.asarray(0), jnp.asarray(0))

    def after(self, stiffness: Any, counts: Any) -> "StiffnessGuard":
        """Return the guard after an attempt with h‖Δf̃‖/‖Δx‖ = `stiffness`, which may not count."""
        above = counts & (stiffness > _LIMIT)
        below = counts & (stiffness <= _LIMIT)
        clear = jnp.where(above, 0, jnp.where(below, self.clear + 1, self.clear))
        votes = jnp.where(above, self.votes + 1, self.votes)
        return StiffnessGuard(jnp.where(clear >= _CLEAR, 0, votes), clear)

    def fires(self, stiffness: Any, counts: Any, remaining: Any, least: Any) -> Any:
        """Return whether the run should end after this attempt: of its size `remaining` more steps are
        needed, and another method is worth its own program from the `least` on. A short step before
        a kink says nothing of the sizes to come, and does not end the run."""
        is_limited = counts & (stiffness > _LIMIT)
        return is_limited & (self.votes >= _VOTES) & (remaining >= least)
