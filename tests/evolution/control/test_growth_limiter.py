"""The growth limiter: the size that the error allows, within limits."""

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
def test_the_next_error_is_half_of_the_tolerance(order, error):
    size = grown(error, order)
    if 0.1 < size < MAX_GROWTH:
        assert error * size**order == pytest.approx(0.5)
    else:
        assert size in (0.1, MAX_GROWTH)


def test_a_size_within_a_fifth_stays_where_it_was_accepted():
    assert grown(0.4) == 1.0
    assert grown(0.4, accepted=NO) == pytest.approx((0.5 / 0.4) ** 0.5)


def test_growth_is_held_back_after_a_rejection_and_comes_back_in_nine_steps():
    limiter = SETTLED.after(NO, NO, 128.0)
    sizes = []
    for _ in range(10):
        sizes.append(grown(1e-9, limiter=limiter))
        limiter = limiter.after(YES, NO, 128.0)
    assert sizes[0] == 1.0 and sizes == sorted(sizes)
    assert sizes[3] == pytest.approx(1.0 + 0.12 * 9) and sizes[6] == MAX_GROWTH
    # A rejection at an event does not reset the count.
    assert float(SETTLED.after(NO, YES, 128.0).accepted_in_a_row) == 9.0


def test_the_first_step_may_grow_more():
    tried = attempt(1e-12, 1.0)
    assert float(SETTLED.factor(tried, 2, YES, 1e3)[1]) == 1e3
    assert float(SETTLED.after(NO, NO, 9.0).factor(tried, 2, YES, 1e3)[1]) == 1.0


def test_an_excursion_limits_growth_and_shortens_the_step_where_it_is_too_large():
    assert float(limit_by_excursion(5.0, jnp.asarray(0.0))) == 5.0
    assert float(limit_by_excursion(5.0, jnp.asarray(0.81))) == pytest.approx(1.0)
    assert float(limit_by_excursion(5.0, jnp.asarray(1.001))) == pytest.approx(0.3)


def test_a_step_that_a_stop_cut_short_does_not_change_the_plan():
    short = attempt(1e-3, 0.1)
    assert float(resume_planned(0.5, short, YES, 1.0)) == 1.0
    assert float(resume_planned(0.01, short, YES, 1.0)) == pytest.approx(0.03)
    assert float(resume_planned(0.5, short, NO, 1.0)) == 0.5
