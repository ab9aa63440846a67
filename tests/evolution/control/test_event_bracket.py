"""The event bracket: steps end before an event, cross it, and continue."""

import jax.numpy as jnp
import numpy as np
import pytest
from tests.evolution.control.attempts import NO, YES, attempt

from dvax.evolution.control.event_bracket import EventBracket

NOTHING = EventBracket.no_event(jnp.asarray(0.0))
NEVER = jnp.asarray(np.inf)


def located(time, size=0.1, before=NOTHING):
    return before.after(attempt(5.0, size), jnp.asarray(time), size, YES)


def test_event_bracket_without_event_does_not_limit_the_step():
    assert float(NOTHING.limit(0.3, jnp.asarray(1.0))) == 1.0
    assert not bool(NOTHING.is_known())


def test_event_bracket_ends_a_step_before_the_event_and_the_next_after_it():
    bracket, directed = located(0.35)
    assert bool(directed)
    before = bracket.limit(0.3, jnp.asarray(1.0))
    assert float(before) == pytest.approx(0.35 - 0.002)
    assert float(bracket.limit(before, jnp.asarray(1.0))) == pytest.approx(0.35 + 0.002)
    # No sliver is left before a stop.
    assert float(bracket.limit(before, jnp.asarray(0.353))) == 0.353


def test_event_bracket_narrows_with_an_estimate_from_a_smaller_step():
    first, _ = located(0.35)
    second, _ = located(0.3501, 0.004, first)
    assert float(second.margin) < 0.1 * float(first.margin)
    assert float(second.margin) >= 4.0 * 1e-14


def test_event_bracket_discards_a_passed_event():
    bracket, _ = located(0.35)
    assert bool(bracket.discard_passed(0.34).is_known())
    assert not bool(bracket.discard_passed(0.36).is_known())


def test_event_bracket_of_an_accepted_step_locates_no_event():
    bracket, directed = NOTHING.after(attempt(0.5, 0.1), jnp.asarray(0.35), 0.1, NO)
    assert not bool(directed) and not bool(bracket.is_known())


def test_event_bracket_directs_at_most_eight_steps_without_progress():
    bracket, count = NOTHING, 0
    for _ in range(20):
        bracket, directed = located(0.35, 0.1, bracket)
        count += bool(directed)
    assert count == 8
    # One step of a tenth of the planned size is progress.
    bracket, _ = bracket.after(attempt(0.5, 0.02), NEVER, 0.1, NO)
    assert bool(located(0.35, 0.1, bracket)[1])
