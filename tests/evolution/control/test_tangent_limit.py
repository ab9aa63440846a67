"""The tangent limit: steps that a derivative can take, and the slope that limits them."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.evolution.control.attempts import NO, YES, attempt

import dvax
from dvax import spaces
from dvax.evolution.control import TangentLimit
from dvax.evolution.power_iteration import (
    images,
    pattern,
    refine,
    remaining,
    variation,
)
from dvax.evolution.stepper import Fastest

ZERO = jnp.asarray(0.0)

# (order, stable, R(z)) of an explicit method; its tangents are multiplied by R(z) and not by e^z.
METHODS = [
    (2, 2.0, lambda z: 1 + z + z**2 / 2),
    (4, 2.7, lambda z: 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24),
]


def longest(
    limit, slope, decay, size=1.0, variation=0.0, error=1.0, remaining=0.0, forcing=0.0,
    of_rest=0.0, ends=NO,
):  # fmt: skip
    numbers = slope, variation, forcing, remaining, slope
    fastest = Fastest(*map(jnp.asarray, numbers), YES, ends, NO)
    return limit.of(fastest, jnp.stack([jnp.asarray(decay), of_rest]), attempt(error, size))


@pytest.mark.parametrize(("order", "stable", "R"), METHODS)
@pytest.mark.parametrize("rtol", [1e-3, 1e-6, 1e-10])
def test_tangent_limit_resolves_a_tangent_to_ten_tolerances_in_its_time(order, stable, R, rtol):
    limit = TangentLimit(jnp.asarray(rtol), 100.0, order, stable)
    for slope in (0.1, 3.0, 1e5):
        z = float(longest(limit, slope, 0.0).longest) * slope
        if z < 0.8 * 0.8 * stable:
            for turn in (1.0, -1.0, 1j):
                error = abs(R(turn * z) / np.exp(turn * z) - 1.0) / z
                assert error <= 10.0 * rtol * np.exp(z)
        assert z <= 0.8 * stable


@pytest.mark.slow
@pytest.mark.parametrize(("order", "stable", "R"), METHODS)
def test_tangent_limit_rises_to_stability_as_tangents_decay(order, stable, R):
    limit = TangentLimit(jnp.asarray(1e-5), 100.0, order, stable)
    slope, decay, z = 7.0, jnp.zeros(2), 0.0
    for _ in range(400):
        z = float(longest(limit, slope, decay[0]).longest) * slope
        fastest = Fastest(jnp.asarray(z), ZERO, ZERO, ZERO, ZERO, YES, NO, YES)
        decay = limit.after(fastest, decay, jnp.asarray(1e-3), YES, NO)
    assert z == pytest.approx(0.8 * 0.8 * stable) and abs(R(-z)) < 1.0
    # It falls back where tangents are excited, and where they do not decay.
    steady = Fastest(jnp.asarray(z), ZERO, ZERO, ZERO, ZERO, NO, NO, YES)
    for at, excited in ((fastest, YES), (steady, NO)):
        assert float(limit.after(at, decay, jnp.asarray(1e-3), YES, excited)[0]) == 0.0
    # At rest it rises more slowly.
    slow, fast = (
        float(limit.after(fastest, jnp.zeros(2), jnp.asarray(error), YES, NO)[0])
        for error in (1e-12, 1e-3)
    )
    assert slow == pytest.approx(0.1 * fast)


def test_tangent_limit_keeps_a_step_size_within_a_fifth_and_ignores_a_slope_of_zero():
    limit = TangentLimit(jnp.asarray(1e-6), 100.0, 4, 2.7)
    assert float(longest(limit, 0.0, 0.0).longest) == np.inf
    bound = longest(limit, 1.0, 0.0)
    aim = float(bound.longest)
    for present, wanted, size in (
        (aim, 5.0, aim),
        (0.85 * aim, 5.0, 0.85 * aim),
        (0.7 * aim, 5.0, aim),
        (1.3 * aim, 5.0, aim),
        (aim, 0.5 * aim, 0.5 * aim),
    ):
        assert float(bound.limit(wanted, present)) == pytest.approx(size)


def refined(space, push, d, p):
    ((one, two),), _ = images(lambda v, weights: push(v), (d,), 0)
    return refine(space, d, one, two, p)


def spectrum(kind, n, rng):
    rates = np.geomspace(0.1, 40.0, n)
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    if kind == "diffusion":
        return np.diag(-rates), True
    if kind == "symmetric":
        return Q @ np.diag(-rates) @ Q.T, True
    if kind == "growth":
        return Q @ np.diag(rates) @ Q.T, False
    m = n // 2
    zero, one = np.zeros((m, m)), np.eye(m)
    return np.block([[zero, one], [-np.diag(rates[1::2] ** 2), -0.01 * one]]), False


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["diffusion", "symmetric", "growth", "oscillation"])
@pytest.mark.parametrize("n", [2, 20])
def test_power_iteration_finds_the_spectral_radius(kind, n):
    B, decays = spectrum(kind, n, np.random.default_rng(n))
    space = spaces.L2(np.linspace(0.5, 2.0, n))
    p = direction = pattern(space, jnp.zeros(n))
    assert float(space.norm(p)) == pytest.approx(1.0)
    for _ in range(40):
        found = refined(space, lambda v: B @ v, direction, p)
        direction = found.direction
    assert 0.85 * 40.0 <= float(found.slope) <= 1.15 * 40.0
    assert bool(found.is_damped) == decays


@pytest.mark.slow
def test_what_has_not_decayed_is_an_oscillation_or_the_slowest_solution():
    rng, space = np.random.default_rng(1), spaces.Euclidean(6)
    for w in (0.0, 3.0, 20.0, 42.0):
        B = np.diag([0.0, 0.0, -0.1, -2.0, -15.0, -40.0])
        B[0, 1], B[1, 0] = w, -w
        Q = np.linalg.qr(rng.normal(size=(6, 6)))[0]
        p = e = pattern(space, jnp.zeros(6))
        sigma = max(40.0, w)
        for _ in range(60):
            ((one, two),), _ = images(lambda v, _, B=Q @ B @ Q.T: B @ v, (e,), 0)
            slope, ends, e = remaining(space, e, one, two, jnp.asarray(sigma), p)
        assert 0.5 * w <= float(slope) <= 1.1 * max(w, 3.0)
        assert not bool(ends)


@pytest.mark.slow
def test_the_counted_decay_of_what_remains_is_at_most_that_of_the_slowest_solution():
    limit, rng = TangentLimit(jnp.asarray(1e-6), 100.0, 4, 2.7), np.random.default_rng(2)
    counted = []
    for case in range(12):
        count = 1 if case == 0 else 5
        rates = np.sort(10.0 ** rng.uniform(-2, 2, count)) if case else np.array([4.0])
        Q = np.linalg.qr(rng.normal(size=(count, count)))[0] if case % 2 else np.eye(count)
        B, space = -Q @ np.diag(rates) @ Q.T, spaces.Euclidean(count)
        p = e = pattern(space, jnp.zeros(count))
        sigma, decay, t = rates[-1], jnp.zeros(2), 0.0
        step = jax.jit(
            lambda e, B=B, p=p, space=space, sigma=sigma: remaining(
                space, e, B @ e, B @ (B @ e), jnp.asarray(sigma), p
            )
        )
        for _ in range(300):
            z = rng.choice([0.3, 1.0, 2.2])
            slope, ends, e = step(e)
            fastest = Fastest(jnp.asarray(z), ZERO, ZERO, slope * z / sigma, ZERO, YES, ends, NO)
            decay, t = limit.after(fastest, decay, jnp.asarray(1e-3), YES, NO), t + z / sigma
            assert float(decay[1]) <= rates[0] * t + 1.0
        counted.append(float(decay[1]))
    assert counted[0] == 40.0 and sum(c > 1.0 for c in counted) >= 4
    free = Fastest(jnp.asarray(z), ZERO, ZERO, slope, ZERO, YES, NO, NO)
    assert float(limit.after(free, decay, jnp.asarray(1e-3), YES, NO)[1]) == 0.0


def test_images_are_those_of_two_applications_and_of_each_parameter():
    rng = np.random.default_rng(0)
    B, G = rng.normal(size=(3, 3)), rng.normal(size=(4, 3))
    trees = [(jnp.asarray(rng.normal(size=3)), jnp.asarray(rng.normal())) for _ in range(3)]
    twice, forced = images(lambda v, w: (B @ v[0] + w @ G, 2.0 * v[1] + w[0]), tuple(trees), 4)
    for (v, a), (one, two) in zip(trees, twice, strict=True):
        np.testing.assert_allclose(one[0], B @ v, rtol=1e-13)
        np.testing.assert_allclose(two[0], B @ B @ v, rtol=1e-13)
        assert float(one[1]) == 2.0 * a and float(two[1]) == 4.0 * a
    np.testing.assert_allclose(forced[0], G, rtol=1e-14)
    np.testing.assert_array_equal(forced[1], [1.0, 0.0, 0.0, 0.0])


@pytest.mark.slow
def test_power_iteration_finds_the_radius_in_any_units():
    # Entries in units a and b: a calcium concentration in mol/L beside a voltage in mV.
    space = spaces.Euclidean(2)
    for units in ([1.0, 1.0], [1e-6, 1.0], [1e-9, 300.0], [1e6, 1e-6]):
        S = np.diag(units)
        B = S @ np.array([[-1.0, 1.0], [1.0, -2.0]]) @ np.linalg.inv(S)
        p = direction = pattern(space, jnp.asarray([0.7, 1.3]) * jnp.asarray(units))
        for _ in range(10):
            found = refined(space, lambda v, B=B: B @ v, direction, p)
            direction = found.direction
        assert float(found.slope) == pytest.approx(2.618, rel=0.2)


def test_power_iteration_sees_the_exchange_of_equal_parts():
    start = pattern(spaces.Product(spaces.Euclidean(4), spaces.Euclidean(4)), (jnp.ones(4),) * 2)
    assert float(jnp.max(jnp.abs(start[0] - start[1]))) > 0.1


def test_power_iteration_waits_where_nothing_moves():
    space, zero = spaces.Euclidean(3), jnp.zeros(3)
    start = pattern(space, zero)
    for push in (jnp.zeros_like, lambda v: jnp.full(3, jnp.nan)):
        found = refined(space, push, start, start)
        assert float(found.slope) == 0.0 and jnp.array_equal(found.direction, start)


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvax.ETD4RK(), dvax.DormandPrince()], ids=["three", "four"])
def test_variation_is_the_frequency_of_a_wave_and_zero_for_a_polynomial(method):
    nodes = (0.0, *method.samples, 1.0)
    space, at = spaces.Euclidean(2), jnp.asarray(nodes)
    for turn in (0.03, 0.3, 1.0):
        rows = jnp.stack([jnp.cos(turn * at), jnp.sin(turn * at)], 1)
        assert float(variation(space, nodes, rows)[0]) == pytest.approx(turn, rel=0.05)
    degree = len(nodes) - 2
    rows = jnp.stack([at**degree, 1.0 - 3.0 * at], 1)
    # The root of a rounding.
    assert float(variation(space, nodes, rows)[0]) <= (1e4 * np.finfo(float).eps) ** (
        1 / (degree + 1)
    )
    # Samples of a wave that is much faster show that it is not resolved, unless they meet the same
    # phase by chance.
    turns = np.outer(np.random.default_rng(len(nodes)).uniform(5.0, 1e3, 400), nodes)
    rows = jnp.stack([jnp.cos(turns), jnp.sin(turns)], 2)
    found = jax.vmap(lambda rows: variation(space, nodes, rows)[0])(rows)
    assert np.mean(found >= 1.0) >= 0.98
    assert float(variation(space, (1.0,), rows[0, :1])[0]) == 0.0


@pytest.mark.parametrize("order", [2, 4, 5])
def test_tangent_limit_resolves_a_forcing_whether_the_state_moves_or_not(order):
    limit = TangentLimit(jnp.asarray(1e-6), 1.0, order, 3.0)
    for error in (0.0, 1e-3, 1.0):
        found = [
            float(longest(limit, 1e-9, 0.0, forcing=z, error=error).longest) for z in (1.0, 4.0)
        ]
        # (hω)^p/(p+1)! is 10 rtol, with the usual distance.
        resolved = (math.factorial(order + 1) * 1e-5) ** (1.0 / order)
        assert found == pytest.approx([0.8 * resolved, 0.2 * resolved])


@pytest.mark.parametrize("order", [2, 4, 5])
def test_tangent_limit_resolves_a_variation_in_time_at_rest_alone(order):
    limit = TangentLimit(jnp.asarray(1e-6), 1.0, order, 3.0)
    accurate = float(longest(limit, 1.0, 0.0).longest)
    # With a slope of 1 a wave of the frequency 4 needs steps a quarter as long.
    at_rest = longest(limit, 1.0, 0.0, variation=4.0, error=0.0)
    assert float(at_rest.longest) == pytest.approx(accurate / 4.0)
    assert not bool(at_rest.is_short_enough)
    moving = longest(limit, 1.0, 0.0, variation=4.0, error=1e-3)
    assert float(moving.longest) == pytest.approx(accurate)
    # A slope that changes nothing within the run needs no steps.
    assert float(longest(limit, 1e-30, 0.0, variation=4.0, error=0.0).longest) > 100.0
    # Rounding on a kink is a variation in every step: the finest ones pass.
    finest = longest(limit, 1e-9, 0.0, size=2e-4, variation=4.0, error=0.0)
    assert bool(finest.is_short_enough) and float(finest.longest) >= 1e-4


def test_tangent_limit_of_a_method_that_linearises_grows_as_the_square_of_the_step():
    # The change of f' over a step, and the step, are both proportional to it.
    limit = TangentLimit(jnp.asarray(1e-6), 100.0, 4, 3.0, True)
    bound = float(longest(limit, 1.0, 0.0).longest)
    assert float(longest(limit, 4.0, 0.0, size=2.0).longest) == pytest.approx(bound)


def test_tangent_limit_resolves_what_has_not_decayed_whatever_has():
    limit = TangentLimit(jnp.asarray(1e-6), 100.0, 4, 2.7)
    resolved = float(longest(limit, 1.0, 0.0).longest)
    assert float(longest(limit, 1.0, 30.0).longest) > 5.0 * resolved
    assert float(longest(limit, 1.0, 30.0, remaining=0.5).longest) == pytest.approx(2.0 * resolved)
    after = dict(remaining=0.5, of_rest=30.0)
    assert float(longest(limit, 1.0, 30.0, **after, ends=YES).longest) > 5.0 * resolved
    assert float(longest(limit, 1.0, 30.0, **after).longest) == pytest.approx(0.8 * 1.0 / 0.5)


def test_tangent_limit_crosses_a_kink_by_a_step_of_ten_errors_alone():
    limit = TangentLimit(jnp.asarray(1e-6), 100.0, 4, 2.7)
    assert bool(longest(limit, 0.9e-4, 0.0).may_cross)
    assert not bool(longest(limit, 1.1e-4, 0.0).may_cross)
