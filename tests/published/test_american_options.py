"""Published values of American puts, by dvax and by methods that share no code with it."""

from functools import partial

import jax
import numpy as np
import pytest
from benchmarks.american_put import Grid, Put, at_price, boundary, enclose, solve, values
from benchmarks.peers.american import IntegralEquation, finite_differences, tree

BINOMIAL = Put(0.05, 0.0, 0.2)
BINOMIAL_VALUES = {0.9: 11.4928, 1.0: 6.0903, 1.1: 2.9866, 1.2: 1.3672}
"""Mathematics 8(9), 1563 (2020), column "Binomial": S/K, and the value for the strike 100."""
HODIE = Put(0.04, 0.02, 0.3)
HODIE_VALUES = {
    0.759572: 25.32986, 0.839457: 19.49691, 0.927743: 14.26265, 1.025315: 9.84354,
    1.133148: 6.36558, 1.252323: 3.83337, 1.384031: 2.13784,
}  # fmt: skip
"""Advances in Difference Equations 2018, 1917, Table 4, column "True values"."""
BOUNDARY = Put(0.1, 0.0, 0.2)
PRICES = np.array(list(BINOMIAL_VALUES))


def exact(put: Put, prices: np.ndarray) -> np.ndarray:
    equation = IntegralEquation(*put)
    return np.array([equation.value(S) for S in prices])


def test_three_methods_without_dvax_agree():
    for put, published in ((BINOMIAL, BINOMIAL_VALUES), (HODIE, HODIE_VALUES)):
        prices = np.array(list(published))
        found = exact(put, prices)
        trees = np.array([tree(S, *put, 2000) for S in prices])
        coarse, fine = (finite_differences(*put, n, 2 * n)(prices) for n in (100, 200))
        assert np.abs(trees - found).max() < 1e-6
        assert np.abs((4 * fine - coarse) / 3 - found).max() < 2e-6


def test_published_binomial_values_are_wrong_in_the_last_digit():
    off = np.array(list(BINOMIAL_VALUES.values())) - 100 * exact(BINOMIAL, PRICES)
    assert np.all((6e-5 < np.abs(off)) & (np.abs(off) < 1e-4)), off
    # Rounding to four digits would change them by at most 5e-5.
    trees = [round(100 * tree(S, *BINOMIAL, 4000), 4) for S in PRICES]
    assert trees == [11.4927, 6.0904, 2.9865, 1.3671]


def test_two_of_the_seven_published_true_values_are_off_by_more_than_rounding():
    prices = np.array(list(HODIE_VALUES))
    off = np.array(list(HODIE_VALUES.values())) - 100 * exact(HODIE, prices)
    equation = IntegralEquation(*HODIE)
    slope = [(equation.value(S + 1e-4) - equation.value(S - 1e-4)) / 2e-4 for S in prices]
    rounding = 5e-5 * np.abs(slope) + 5e-6  # of the price, and of the value
    assert np.all((np.abs(off) > 3 * rounding) == [0, 0, 0, 0, 1, 0, 1]), off / rounding
    assert np.count_nonzero(np.abs(off) <= 1.3 * rounding) == 5, off / rounding
    assert np.abs(off).max() < 1.5e-4


@pytest.fixture(scope="module")
def grid() -> Grid:
    return Grid.of(BINOMIAL, 20)


@pytest.fixture(scope="module")
def wide(grid):
    return enclose(grid, BINOMIAL, 4e-3, 1e-3, PRICES)


@pytest.mark.slow
def test_two_laws_enclose_the_value_and_the_certificate_is_proved(grid, wide):
    narrow = enclose(grid, BINOMIAL, 1e-3, 1e-4, PRICES)
    assert wide.status == narrow.status == "proved"
    rounding = 1e-6
    assert np.all(wide.low <= narrow.low + rounding) and np.all(narrow.high <= wide.high + rounding)
    assert np.all(narrow.low <= narrow.high)
    # ε max u = εr, as u ≤ rK − dS.
    assert np.all(narrow.high - narrow.low <= 1e-3 * BINOMIAL.rate * 1.01)
    on_grid = 1.5e-5  # the error of differences on this grid, measured at 1.3e-5
    assert np.all(
        np.abs(narrow.values - exact(BINOMIAL, PRICES)) <= narrow.penalty + narrow.time + on_grid
    )


@pytest.mark.slow
def test_bound_of_the_time_integration_exceeds_its_error(grid, wide):
    tight = enclose(grid, BINOMIAL, 4e-3, 1e-6, PRICES)
    for rough, fine in ((wide.low, tight.low), (wide.high, tight.high)):
        error = np.abs([float(at_price(grid, rough - fine, S)) for S in PRICES])
        assert np.all((0.0 < error) & (error <= wide.time)), error / wide.time


def extrapolated(coarse, fine):
    return (4 * np.asarray(fine) - np.asarray(coarse)) / 3


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("put", "published"),
    [(BINOMIAL, BINOMIAL_VALUES), (HODIE, HODIE_VALUES)],
    ids=["binomial", "HODIE"],
)
def test_values_agree_with_the_integral_equation_to_six_digits(put, published):
    prices = np.array(list(published))
    coarse, fine = (enclose(Grid.of(put, cells), put, 2e-4, 1e-5, prices) for cells in (40, 80))
    assert coarse.status == fine.status == "proved"
    found = extrapolated(coarse.values, fine.values)
    assert np.abs(found - exact(put, prices)).max() < 1e-7
    penalty, steps = ((4 * getattr(fine, n) + getattr(coarse, n)) / 3 for n in ("penalty", "time"))
    assert np.all(penalty + steps < 5e-5)
    assert np.abs(100 * found - list(published.values())).max() < 1.5e-4


@pytest.mark.thorough
def test_exercise_boundary_lies_among_the_published_ones():
    grid = Grid.of(BOUNDARY, 160)
    runs = [solve(grid, BOUNDARY, 1e-4, above, 1e-4) for above in (False, True)]
    ends = [values(grid, BOUNDARY, run.xs[-1]) for run in runs]
    found = boundary(grid, BOUNDARY, 0.5 * (ends[0] + ends[1]))
    assert found == pytest.approx(float(IntegralEquation(*BOUNDARY).boundary(1.0)), abs=1e-5)
    assert 0.8622 < found < 0.8628


def price(grid, S, rate, volatility):
    put = Put(rate, 0.0, volatility)
    runs = [solve(grid, put, 5e-4, q, 1e-4, adjoint="forward").xs[-1] for q in (False, True)]
    return at_price(grid, values(grid, put, 0.5 * (runs[0] + runs[1])), S)


@pytest.mark.thorough
def test_derivatives_and_implied_volatility():
    grids = [Grid.of(BINOMIAL, cells) for cells in (20, 40)]
    forward = [jax.jit(jax.jacfwd(partial(price, grid), argnums=(0, 1, 2))) for grid in grids]
    plain = [jax.jit(partial(price, grid)) for grid in grids]
    numbers = (1.0, BINOMIAL.rate, BINOMIAL.volatility)
    delta, rho, vega = extrapolated(*(np.array(fn(*numbers)) for fn in forward))

    def central(place: int, h: float = 1e-3) -> float:
        ends = []
        for sign in (1, -1):
            S, rate, volatility = (v + sign * h * (k == place) for k, v in enumerate(numbers))
            ends.append(IntegralEquation(rate, 0.0, volatility, 1.0).value(S))
        return (ends[0] - ends[1]) / (2 * h)

    assert [delta, rho, vega] == pytest.approx([central(k) for k in range(3)], abs=5e-5)
    # Newton's method with the derivative of dvax recovers the volatility of a value of the reference.
    quote, volatility = IntegralEquation(0.05, 0.0, 0.3, 1.0).value(1.0), 0.2
    for _ in range(4):
        at = (1.0, 0.05, volatility)
        slope = extrapolated(*(np.array(fn(*at))[2] for fn in forward))
        volatility -= (extrapolated(*(float(fn(*at)) for fn in plain)) - quote) / slope
    assert volatility == pytest.approx(0.3, abs=5e-5)
