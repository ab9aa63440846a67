"""The growth limiter: by how much a step may be longer than the one before."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax

from .error_test import Attempt

MAX_GROWTH = 5.0
"""Largest growth factor of the step size."""

_SAFETY = 0.5
"""Error, in tolerances, at which the next step aims."""

_MAX_CUT = 0.1
"""Least factor of the step size."""

_EXCURSION_CUT = 0.6
"""Largest factor of the step size after a step that may hide an excursion."""

_FACTOR_BITS = 10
"""Binary digits of a factor of the step size: it is then within 0.05 % of its value."""

GROWTH_RATE, GROWTH_STEPS = 0.12, 9.0
"""After k accepted steps in a row the growth factor is limited to 1 + 0.12 k², k ≤ 9."""


class GrowthLimiter(NamedTuple):
    """Limit the growth of steps after a rejection.

    The size that was just rejected is not tried again at once: in a field, where steps meet kinks or
    miss them, one good step says little about the next one.
    """

    accepted_in_a_row: Any

    @staticmethod
    def at_start(like: Any) -> "GrowthLimiter":
        return GrowthLimiter(GROWTH_STEPS * jnp.ones_like(like))

    def factor(self, attempt: Attempt, order: int, at_start: Any, first_growth: Any) -> Any:
        """Return the factor for the step size that the error allows, before any limit, and the limit:
        `first_growth` for the step `at_start`, whose size nothing but the span has chosen."""
        positive = jnp.where(attempt.error > 0.0, attempt.error, 1.0)
        factor = (_SAFETY / positive) ** (1.0 / order)
        factor = jnp.where(attempt.error > 0.0, factor, jnp.inf)
        limit = jnp.minimum(1.0 + GROWTH_RATE * self.accepted_in_a_row**2, MAX_GROWTH)
        first = at_start & (self.accepted_in_a_row >= GROWTH_STEPS)
        return factor, jnp.where(first, first_growth, limit)

    def after(self, accepted: Any, at_event: Any, most: Any) -> "GrowthLimiter":
        """Count an attempt, up to `most`. A rejection that an event explains (`at_event`) does not
        reset the count."""
        kept = jnp.minimum(self.accepted_in_a_row + 1.0, most)
        rejected = jnp.where(at_event, jnp.maximum(self.accepted_in_a_row, 1.0), 0.0)
        return GrowthLimiter(jnp.where(accepted, kept, rejected))


def limit_by_excursion(limit: Any, excursion: Any) -> Any:
    """Limit the growth where data may move between the samples of a step: the width of an enclosure
    falls with h², and often its distance from a change of sign as well."""
    room = _rounded(0.9 * jnp.where(excursion > 0.0, excursion, 1.0) ** -0.5)
    room = jnp.where(excursion > 1.0, jnp.minimum(room, _EXCURSION_CUT), room)
    return jnp.where(excursion > 0.0, jnp.minimum(limit, room), limit)


def next_size(attempt: Attempt, accepted: Any, factor: Any, limit: Any) -> Any:
    """Return the next step size. One that is within a fifth of the present size leaves it as it is:
    a new size costs new φ-functions."""
    factor = jnp.clip(_rounded(factor), _MAX_CUT, jnp.maximum(limit, _MAX_CUT))
    steady = accepted & (factor > 0.8) & (factor < 1.25)
    return jnp.where(steady, attempt.size, attempt.size * factor)


def _rounded(factor: Any) -> Any:
    """Round a factor to `_FACTOR_BITS` binary digits. Sums over a state depend on the number of
    devices in their last digits, and a defect, which is a small difference, in more of them. Kinks
    amplify such a difference from step to step: without rounding, one device and eight took 5849 and
    5829 steps."""
    kind = jnp.finfo(jnp.result_type(factor))
    return lax.reduce_precision(factor, kind.nexp, _FACTOR_BITS)


def resume_planned(size: Any, attempt: Attempt, accepted: Any, planned: Any) -> Any:
    """Return to the `planned` step size after a step that a stop cut short: such a step says little
    about it."""
    cut = accepted & (attempt.size < 0.99 * planned)
    return jnp.where(cut, jnp.maximum(size, jnp.minimum(planned, 3.0 * size)), size)
