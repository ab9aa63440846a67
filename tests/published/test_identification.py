"""Derivatives at work: fits find the parameters within their standard errors, and a proved modulus is a
lower bound."""

import jax
import numpy as np
import pytest
from benchmarks import inverse_problems as inverse
from benchmarks.inverse_problems import fit
from benchmarks.peers import ngspice
from tests.once import once
from tests.selection import mostly_thorough


@once
def field(side):
    model = inverse.field_model(side)
    return jax.jit(model), jax.jit(jax.jacfwd(model))


@once
def rectifier():
    return jax.jit(inverse.rectifier_model), jax.jit(jax.jacfwd(inverse.rectifier_model))


@once
def training():
    return inverse.Training()


def within_three_errors(result, truth):
    apart = (result.found - truth) / result.spread
    assert np.abs(apart).max() <= 3.0, apart
    return apart


SIDES = [(16, seed) for seed in range(8)] + [(100, seed) for seed in range(4)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("side", "seed"), mostly_thorough(SIDES, [(16, seed) for seed in range(3)])
)
def test_parameters_of_a_contact_field_are_found_within_three_standard_errors(side, seed):
    solve, jacobian = field(side)
    data = inverse.noisy(solve(inverse.FIELD_TRUTH), seed)
    result = fit(solve, data, inverse.FIELD_START, jacobian)
    within_three_errors(result, inverse.FIELD_TRUTH)
    assert result.chi2 == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / data.size))


@pytest.mark.slow
def test_pressure_law_of_the_field_agrees_with_scipy():
    # The errors of ETD2RK at kinks, which fixed steps do not meet, are below the noise of the data.
    solve, _ = field(16)
    other = inverse.field_model_scipy(16)(inverse.FIELD_TRUTH)
    assert np.abs(np.asarray(solve(inverse.FIELD_TRUTH)) - other).max() <= 0.05


@pytest.mark.thorough
def test_standard_errors_of_the_field_are_those_of_many_fits():
    solve, jacobian = field(16)
    clean = solve(inverse.FIELD_TRUTH)
    fits = [
        fit(solve, inverse.noisy(clean, seed), inverse.FIELD_START, jacobian) for seed in range(200)
    ]
    apart = np.array([(each.found - inverse.FIELD_TRUTH) / each.spread for each in fits])
    # The standard deviation of 200 normal numbers is known to 5 % (three of these are allowed).
    assert np.abs(apart.std(axis=0) - 1.0).max() <= 0.15
    assert np.abs(apart.mean(axis=0)).max() <= 3.0 / np.sqrt(200)


@pytest.mark.slow
@pytest.mark.parametrize("seed", mostly_thorough(range(8), [0, 1, 2]))
def test_parameters_of_a_rectifier_are_found_from_scipys_trajectory(seed):
    solve, jacobian = rectifier()
    data = inverse.noisy(inverse.rectifier_model_scipy(inverse.RECTIFIER_TRUTH), seed)
    result = fit(solve, data, inverse.RECTIFIER_START, jacobian)
    within_three_errors(result, inverse.RECTIFIER_TRUTH)


@pytest.mark.skipif(not ngspice.found(), reason="ngspice is not on the PATH (Debian: ngspice)")
def test_parameters_of_a_rectifier_are_found_from_the_trajectory_of_ngspice():
    solve, jacobian = rectifier()
    clean = inverse.rectifier_by_ngspice()
    assert np.abs(clean - inverse.rectifier_model_scipy(inverse.RECTIFIER_TRUTH)).max() <= 0.05
    result = fit(solve, inverse.noisy(clean, 0), inverse.RECTIFIER_START, jacobian)
    within_three_errors(result, inverse.RECTIFIER_TRUTH)


@pytest.mark.slow
def test_voltage_alone_does_not_determine_the_rectifier():
    # v depends on the products of the capacity with both resistances only.
    _, jacobian = rectifier()
    J = np.asarray(jacobian(inverse.RECTIFIER_TRUTH)) * inverse.RECTIFIER_TRUTH
    sizes = np.linalg.svd(J[: len(J) // 2], compute_uv=False)
    assert sizes[-1] <= 1e-10 * sizes[0]
    assert np.linalg.svd(J, compute_uv=False)[-1] >= 1e-3 * sizes[0]


def check_limited(theta, load):
    """Check the proof for a limited network by its derivative on a grid and by difference quotients."""
    check = training().verify(theta, load)
    assert check.status == "proved", check.table()
    least = inverse.sampled_modulus(inverse.network, theta)
    assert 0.0 < float(check.constants.gamma) <= least + 1e-12
    # β_h is a Lipschitz constant of φ, too.
    product = np.prod([np.linalg.norm(np.asarray(W), 2) for W in (theta[0], theta[2])])
    assert product <= inverse.LIPSCHITZ * (1 + 1e-12)
    one = np.random.default_rng(3).uniform(0.0, 1.0, (500, 2, 2))
    phi = jax.vmap(lambda u: inverse.network(theta, u))
    apart = np.linalg.norm(np.asarray(phi(one[:, 0]) - phi(one[:, 1])), axis=1)
    size = np.linalg.norm(one[:, 0] - one[:, 1], axis=1)
    for bound in (product, float(check.constants.beta_h)):
        assert np.all(apart <= bound * size * (1 + 1e-12))
    assert least >= 1.0 - product


NO_LOAD = np.zeros((13, 2))


@pytest.mark.slow
@pytest.mark.parametrize("scale", mostly_thorough([0.2, 0.5, 1.0, 2.0], [1.0]))
def test_network_with_limited_norms_is_proved_well_posed(scale):
    flat = scale * np.random.default_rng(5).normal(size=5 * inverse.WIDTH)
    check_limited(training().weights(flat, 1.0), NO_LOAD)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(6))
def test_trained_network_with_limited_norms_is_proved_well_posed(seed):
    made = training()
    loads, data, weights = made.setting(seed)
    for _ in range(3):
        weights = made.epoch(weights, 1.0, loads, data).x
        check_limited(made.weights(weights, 1.0), loads[0])


def test_modulus_of_the_hidden_law_is_the_known_one():
    grid = inverse.sampled_modulus(inverse.unknown, None)
    assert grid == pytest.approx(inverse.UNKNOWN_MODULUS, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("scale", mostly_thorough([0.3, 1.0, 3.0], [0.3, 1.0]))
def test_proved_modulus_of_a_random_network_is_a_lower_bound(scale):
    made = training()
    flat = scale * np.random.default_rng(7).normal(size=5 * inverse.WIDTH)
    theta = made.weights(flat, np.inf)
    row = made.verify(theta, NO_LOAD)["ass:strong_pseudomono"]
    least = inverse.sampled_modulus(inverse.network, theta)
    if row.status == "proved":
        assert float(made.verify(theta, NO_LOAD).constants.gamma) <= least + 1e-12
    if least < 0.0:
        assert row.status != "proved"


@pytest.mark.thorough
def test_training_without_limits_can_lose_monotonicity():
    made = training()
    loads, data, weights = made.setting(3)
    for _ in range(5):
        weights = made.epoch(weights, np.inf, loads, data).x
    theta = made.weights(weights, np.inf)
    assert inverse.sampled_modulus(inverse.network, theta) < 0.0
    assert made.verify(theta, loads[0]).status != "proved"
