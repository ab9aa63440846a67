"""Steps that end at events: kinks of the response that were located inside rejected steps.

A kink of f̃ inside a step costs the method its order, and making such a step smaller bit by bit gains
nothing. So the controller ends the next step shortly before the event, where the solution is smooth,
crosses the event by a small step, and resumes the planned step size behind it. How small the crossing
may be is found iteratively: the first estimate of the event, from the rejected step, is accurate to
O(h²) or so; where the crossing is rejected too, its own estimate is far better, and so on.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..locate_event import BRACKET
from .error_test import Attempt

_MAX_TRIES = 8
"""Steps in a row that are directed at events without progress: then steps are shortened as others."""

_FIRST_MARGIN = 0.02
"""Uncertainty of an event that one step alone has located, in lengths of that step."""


class EventBracket(NamedTuple):
    """The next event and its uncertainty.

    - `time`: of the event, ∞ where none is known;
    - `margin`: steps end this much before the event and behind it;
    - `size`: of the step in which the event was located;
    - `tries`: steps in a row that were directed at events, accepted or not, since one of a tenth of
      the planned size was accepted.
    """

    time: Any
    margin: Any
    size: Any
    tries: Any

    def pack(self) -> jax.Array:
        """Return one array: a compiled loop is the faster the fewer arrays it carries."""
        return jnp.stack(self)

    @staticmethod
    def unpack(packed: jax.Array) -> "EventBracket":
        return EventBracket(*packed)

    @staticmethod
    def no_event(like: Any) -> "EventBracket":
        return EventBracket(jnp.full_like(like, jnp.inf), *(jnp.zeros_like(like),) * 3)

    def is_known(self) -> Any:
        return self.time < jnp.inf

    def may_try(self) -> Any:
        """Return whether a step may be directed at an event."""
        return self.tries < _MAX_TRIES

    def after(
        self, attempt: Attempt, event: Any, planned: Any, rejected: Any
    ) -> tuple["EventBracket", Any]:
        """Return the bracket after an attempt in which an `event` (∞: none) was located, and whether
        the next step is directed at it; `planned` is the size that steps have without events."""
        h = attempt.size
        directed = rejected & (event < jnp.inf) & self.may_try()
        # The error of an estimate is O(h²), hence (h/size)² of the previous one; one power less and a
        # factor of four are left as a margin. No estimate is closer than the bracket of its search.
        known = self.is_known()
        change = jnp.abs(event - jnp.where(known, self.time, event))
        margin = jnp.minimum(4.0 * change * h / jnp.maximum(self.size, h), _FIRST_MARGIN * h)
        margin = jnp.where(known, margin, _FIRST_MARGIN * h)
        margin = jnp.maximum(margin, jnp.maximum(2.0 * BRACKET * h, 4.0 * attempt.smallest))
        new = EventBracket(event, margin, h, self.tries + 1.0)
        progress = ~rejected & (h >= 0.1 * planned)
        old = self._replace(tries=jnp.where(progress, 0.0, self.tries))
        return EventBracket.unpack(jnp.where(directed, new.pack(), old.pack())), directed

    def discard_passed(self, t: Any) -> "EventBracket":
        """Return the bracket at t: an event behind t is no longer one."""
        nothing = EventBracket.no_event(self.time)._replace(tries=self.tries)
        return EventBracket.unpack(jnp.where(t > self.time, nothing.pack(), self.pack()))

    def limit(self, t: Any, stop: Any) -> Any:
        """Return the latest end of a step from t: before the event, behind it from close by, or the
        next `stop`, where little would be left up to there."""
        near = t >= self.time - 2.0 * self.margin
        end = jnp.where(near, self.time + self.margin, self.time - self.margin)
        return jnp.where(end < stop - self.margin, end, stop)
