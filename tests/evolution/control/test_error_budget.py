"""The error budget covers crossings and cannot be overdrawn."""

import jax.numpy as jnp
import numpy as np
import pytest
from tests.evolution.control.attempts import NO, YES, attempt

from dvax.evolution.control.error_budget import ErrorBudget


def test_error_budget_charges_at_most_the_tolerance_over_random_steps():
    """The sum of all charges stays below the tolerance."""
    rng = np.random.default_rng(0)
    budget, charged = ErrorBudget.at_start(jnp.asarray(1.0)), 0.0
    for _ in range(300):
        tried = attempt(10 ** rng.uniform(-2, 12), 10 ** rng.uniform(-15, 0))
        covered = budget.covers(tried, jnp.asarray(rng.random() < 0.5))
        accepted = (tried.error <= 1.0) | covered
        budget = budget.after(tried, accepted, covered, NO)
        charged += float(tried.integrated) if bool(accepted & (tried.error > 1.0)) else 0.0
    assert 0.0 < charged <= 1.0
    assert float(budget.remaining) == pytest.approx(1.0 - charged, abs=1e-12)


def test_error_budget_does_not_charge_rejected_steps_and_roundoff():
    budget = ErrorBudget.at_start(jnp.asarray(1.0))
    tried = attempt(2.0, 1e-8)
    for accepted, roundoff in ((NO, NO), (YES, YES)):
        assert float(budget.after(tried, accepted, YES, roundoff).remaining) == 1.0
    assert float(budget.after(tried, YES, YES, NO).remaining) < 1.0


def test_error_budget_allows_four_crossings_until_the_next_accurate_step():
    """Four successive crossings are allowed; an accurate step restores the budget."""
    budget, jump = ErrorBudget.at_start(jnp.asarray(1.0)), attempt(1e9, 1e-14)
    for _ in range(4):
        assert bool(budget.may_cross(jump, YES, NO)) and not bool(budget.may_cross(jump, NO, NO))
        budget = budget.after(jump, YES, NO, NO)
    assert not bool(budget.may_cross(jump, YES, NO))
    budget = budget.after(attempt(0.5, 1e-3), YES, NO, NO)
    assert bool(budget.may_cross(jump, YES, NO))
    assert not bool(budget.may_cross(attempt(np.inf, 1e-14), YES, NO))
    assert bool(budget.may_cross(attempt(np.inf, 1e-14), YES, YES))
    assert not bool(budget.may_cross(attempt(1e9, 1e-12), YES, NO))
