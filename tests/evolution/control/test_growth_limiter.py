"""The growth limiter: the step size that the error allows, within limits."""

import jax.numpy as jnp
import pytest
from tests.evolution.control.attempts import NO, YES, attempt

from dvax.evolution.control.growth_limiter import (
    MAX_GROWTH,
    GrowthLimiter,
    limit_by_excursion,
    next_size,
    resume_planned,
)

SETTLED = GrowthLimiter.at_start(jnp.asarray(1.0))


def grown(error, order=2, limiter=SETTLED, accepted=YES):
    tried = attempt(error, 1.0)
    factor, limit = limiter.factor(tried, order, NO, 1e3)
    return float(next_size(tried, accepted, factor, limit))


@pytest.mark.parametrize("order", [1, 2, 4])
@pytest.mark.parametrize("error", [0.01, 0.1, 3.0, 10.0])
def test_growth_limiter_aims_at_half_of_the_tolerance(order, error):
    """The next step has a predicted error of half of the tolerance."""
    size = grown(error, order)
    if 0.1 < size < MAX_GROWTH:
        assert error * size**order == pytest.approx(0.5, rel=order * 2.0**-11)
    else:
        assert size in (0.1, MAX_GROWTH)


def test_growth_limiter_keeps_an_accepted_step_size_within_a_fifth():
    assert grown(0.4) == 1.0
    assert grown(0.4, accepted=NO) == pytest.approx((0.5 / 0.4) ** 0.5, rel=2.0**-11)


def test_growth_limiter_restores_growth_within_nine_steps_after_a_rejection():
    limiter = SETTLED.after(NO, NO, 128.0)
    sizes = []
    for _ in range(10):
        sizes.append(grown(1e-9, limiter=limiter))
        limiter = limiter.after(YES, NO, 128.0)
    assert sizes[0] == 1.0 and sizes == sorted(sizes)
    assert sizes[3] == pytest.approx(1.0 + 0.12 * 9) and sizes[6] == MAX_GROWTH
    # A rejection at an event does not reset the count.
    assert float(SETTLED.after(NO, YES, 128.0).accepted_in_a_row) == 9.0


def test_growth_limiter_allows_more_growth_after_the_first_step():
    tried = attempt(1e-12, 1.0)
    assert float(SETTLED.factor(tried, 2, YES, 1e3)[1]) == 1e3
    assert float(SETTLED.after(NO, NO, 9.0).factor(tried, 2, YES, 1e3)[1]) == 1.0


def test_growth_limiter_respects_excursions():
    """An excursion limits growth, and shortens the step if it is too large."""
    assert float(limit_by_excursion(5.0, jnp.asarray(0.0))) == 5.0
    assert float(limit_by_excursion(5.0, jnp.asarray(0.81))) == pytest.approx(1.0)
    assert float(limit_by_excursion(5.0, jnp.asarray(1.001))) == pytest.approx(0.6)


def test_growth_limiter_ignores_steps_clipped_to_a_stop():
    short = attempt(1e-3, 0.1)
    assert float(resume_planned(0.5, short, YES, 1.0)) == 1.0
    assert float(resume_planned(0.01, short, YES, 1.0)) == pytest.approx(0.03)
    assert float(resume_planned(0.5, short, NO, 1.0)) == 0.5
