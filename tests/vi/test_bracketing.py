"""Pointwise intervals: the number of evaluations of F, and independence of the guess."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.sets import Box
from dvax.vi import RESULTS, Bracketing

INF = np.inf
LAWS = {
    "cubic": (lambda y, c: y + y**3 - c, -2.0, 2.0, (-12.0, 12.0)),
    "pseudomonotone": (lambda y, c: (2 + jnp.sin(y)) * (y - c), 0.0, 4.7, (-2.0, 7.0)),
    "exponential": (lambda y, c: jnp.exp(y) - c, -3.0, 3.0, (-2.0, 25.0)),
    "logarithm": (lambda y, c: jnp.log(y) + y - c, 1e-6, 10.0, (-16.0, 16.0)),
    "saturating": (lambda y, c: y + jnp.tanh(5 * y) - c, -2.0, 2.0, (-4.0, 4.0)),
    "steep": (lambda y, c: jnp.arctan(1e3 * (y - c)), 0.0, 10.0, (-3.0, 13.0)),
    "cubic on a line": (lambda y, c: y + y**3 - c, -INF, INF, (-1e3, 1e3)),
    "exponential on a half line": (lambda y, c: jnp.expm1(y) - c, 0.0, INF, (-5.0, 1e3)),
}
POINTS = 10_000


def solve(name, y0, count=POINTS):
    law, lower, upper, drive = LAWS[name]
    c = jnp.linspace(*drive, count)
    vi = dvax.solve_vi(law, Box(lower, upper), y0, c, Bracketing())
    assert vi.result == RESULTS.successful
    return vi


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_bracketing_needs_at_most_fifteen_evaluations_and_three_from_the_solution(name):
    law, lower, upper, drive = LAWS[name]
    vi = solve(name, jnp.zeros(POINTS))
    assert int(vi.evaluations) <= 15
    c = jnp.linspace(*drive, POINTS)
    # Enclosed to eight spacings: F changes its sign, or a bound holds the point.
    y = np.asarray(vi.y)
    gap = 8 * np.finfo(float).eps * np.abs(y) + 1e-30
    below, above = (np.asarray(law(jnp.clip(y + s * gap, lower, upper), c)) for s in (-1, 1))
    assert np.all((below <= 0) | (y <= lower))
    assert np.all((above >= 0) | (y >= upper))
    assert int(solve(name, vi.y).evaluations) <= 3


def test_bracketing_solution_does_not_depend_on_the_guess():
    found = [solve("pseudomonotone", jnp.full(101, guess), 101).y for guess in (-1e9, 0.3, 1e9)]
    for y in found[1:]:
        np.testing.assert_allclose(np.asarray(y), np.asarray(found[0]), rtol=1e-14, atol=1e-15)


@pytest.mark.slow
def test_bracketing_evaluations_are_bounded_at_roots_with_zero_or_infinite_slope():
    c = jnp.linspace(-0.3, 1.3, 1001)
    for power, most in ((3.0, 240), (0.5, 60)):
        law = lambda y, c, p=power: jnp.sign(y - c) * jnp.abs(y - c) ** p  # noqa: E731
        vi = dvax.solve_vi(law, Box(0.0, 1.0), jnp.zeros(1001), c, Bracketing())
        assert vi.result == RESULTS.successful
        assert int(vi.evaluations) <= most
        np.testing.assert_allclose(np.asarray(vi.y), np.clip(c, 0, 1), atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("bound", [0.9332785790714507, -1e-3, 1e12])
def test_bracketing_from_a_guess_beside_the_bound_returns_the_bound(bound):
    # The guess is a few spacings from the bound: nothing is left to narrow, and no sign has changed.
    for side in (-1.0, 1.0):
        law = lambda y, c, side=side: (y - c) + jnp.tanh(y - c) + 0 * side  # noqa: E731
        far = bound - side * abs(bound)
        K = Box(min(far, bound), max(far, bound))
        spacings = np.arange(9) * np.spacing(abs(bound))
        for guess in bound - side * spacings:
            vi = dvax.solve_vi(law, K, jnp.array([guess]), bound + side, Bracketing())
            assert float(vi.y[0]) == bound and float(vi.residual) == 0.0
