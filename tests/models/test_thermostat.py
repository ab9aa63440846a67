"""The saturated thermostat against eigenfunctions, a manufactured field and a free boundary."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import dvax
from dvax.models.thermostat import Thermostat

KAPPA, GAIN = 0.05, 6.0


def plate(**changed):
    given = dict(
        shape=(24, 16), lengths=(1.5, 1.0), boundary="neumann", diffusion=KAPPA, gain=GAIN,
        reference=20.0, lower=-2.0, upper=3.0, load=0.0,
    )  # fmt: skip
    return Thermostat(**(given | changed))


def mode(model):
    """cos(2πs₁/1.5) cos(πs₂), an eigenfunction of −Δ with insulated walls, and its eigenvalue."""
    s1, s2 = model.points
    phi = np.cos(2 * np.pi * s1 / 1.5) * np.cos(np.pi * s2)
    return jnp.asarray(phi), (2 * np.pi / 1.5) ** 2 + np.pi**2


@pytest.mark.thorough
def test_thermostat_without_saturation_decays_with_both_rates():
    model = plate()
    phi, eigenvalue = mode(model)
    sol = dvax.solve(model.problem, 20.0 + 0.3 * phi, 0.0, 0.5, rtol=1e-8)
    expected = 20.0 + 0.3 * np.exp(-(KAPPA * eigenvalue + GAIN) * 0.5) * np.asarray(phi)
    np.testing.assert_allclose(np.asarray(sol.xs[0]), expected, atol=1e-8)
    assert model.figures(sol)["regulated"] == 1.0


def test_thermostat_at_full_power_is_exact_for_any_step():
    model = plate()
    phi, eigenvalue = mode(model)
    sol = dvax.solve(model.problem, 10.0 + phi, 0.0, 2.0, dt=2.0)
    expected = 10.0 + 3.0 * 2.0 + np.exp(-KAPPA * eigenvalue * 2.0) * np.asarray(phi)
    np.testing.assert_allclose(np.asarray(sol.xs[0]), expected, atol=1e-12)
    figures = model.figures(sol)
    assert figures["heated"] == 1.0 and figures["power"] == pytest.approx(3.0 * 1.5)


@pytest.fixture(scope="module")
def manufactured():
    """x = 20 + a(t)φ with a load to match: the free boundaries are level lines of φ that move."""
    phi, eigenvalue = mode(plate())

    def a(t):
        return 0.9 * jnp.cos(2.0 * t)

    def load(t):
        own = (-1.8 * jnp.sin(2.0 * t) + KAPPA * eigenvalue * a(t)) * phi
        return own - jnp.clip(-GAIN * a(t) * phi, -2.0, 3.0)

    return plate(load=load), phi, lambda t: 20.0 + np.asarray(a(t) * phi)


@pytest.mark.slow
def test_thermostat_manufactured_field_with_moving_free_boundaries(manufactured):
    model, phi, exact = manufactured
    errors = []
    for steps in (40, 80, 160):
        sol = dvax.solve(model.problem, 20.0 + 0.9 * phi, 0.0, 2.0, ts=[1.0, 2.0], dt=2.0 / steps)
        apart = np.asarray(sol.xs) - np.stack([exact(1.0), exact(2.0)])
        errors.append(float(np.max(np.abs(apart))))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 2e-3 and np.all((orders > 1.8) & (orders < 2.3)), (errors, orders)


def test_thermostat_regimes_lie_between_level_lines(manufactured):
    model, phi, exact = manufactured
    for t in (0.0, 0.2, 1.4):
        depth = -GAIN * 0.9 * np.cos(2.0 * t) * np.asarray(phi)
        expected = np.where(depth >= 3.0, 1, np.where(depth <= -2.0, -1, 0))
        regimes = np.asarray(model.regimes(t, jnp.asarray(exact(t))))
        np.testing.assert_array_equal(regimes, expected)
        assert set(np.unique(expected)) == {-1, 0, 1}
        power = np.asarray(model.power(t, jnp.asarray(exact(t))))
        np.testing.assert_allclose(power, np.clip(depth, -2.0, 3.0), atol=1e-12)
        response = np.asarray(model.problem.response(t, jnp.asarray(exact(t))))
        np.testing.assert_allclose(response, power, atol=1e-12)


@pytest.mark.slow
def test_thermostat_bound_is_proved_and_above_the_true_error(manufactured):
    model, phi, exact = manufactured
    ts = np.linspace(0.0, 1.0, 5)
    sol = dvax.solve(model.problem, 20.0 + 0.9 * phi, 0.0, 1.0, ts=ts, rtol=1e-6, atol=1e-4)
    bound = dvax.bound_error(model.problem, sol, model.constants)
    space = model.space
    error = [float(space.norm(x - exact(t))) for t, x in zip(ts, sol.xs, strict=True)]
    assert np.all(np.asarray(bound.x) >= np.array(error) - 1e-13)
    assert 0.0 < error[-1] < float(bound.x[-1]) < 0.05


def free_boundary(kappa, k, g, side):
    """Where a strip with cold walls and a reference of 1 is heated at full power, up to σ from the
    walls: quadratic there, a cosh between, both with a continuous slope."""
    m = np.sqrt(k / kappa)

    def mismatch(sigma):
        slope = (g / k) * m * np.tanh(m * (side / 2 - sigma)) + g * sigma / kappa
        return -g * sigma**2 / (2 * kappa) + slope * sigma - (1 - g / k)

    sigma = brentq(mismatch, 0.0, side / 2, xtol=1e-15)
    C = g / k / np.cosh(m * (side / 2 - sigma))
    slope = C * m * np.sinh(m * (side / 2 - sigma)) + g * sigma / kappa

    def profile(s):
        near = np.minimum(s, side - s)
        heated = -g * near**2 / (2 * kappa) + slope * near
        return np.where(near < sigma, heated, 1 - C * np.cosh(m * (near - side / 2)))

    return sigma, profile


@pytest.mark.slow
def test_thermostat_steady_free_boundary_agrees_with_the_closed_form():
    kappa, k, g = 0.2, 12.0, 4.0
    sigma, profile = free_boundary(kappa, k, g, 1.0)
    assert 0.1 < sigma < 0.4
    errors = []
    for n in (16, 48):
        strip = Thermostat(
            shape=(n, 2), boundary=("dirichlet", "neumann"), diffusion=kappa, gain=k,
            reference=1.0, lower=0.0, upper=g, scheme="differences",
        )  # fmt: skip
        sol = dvax.solve(strip.problem, jnp.zeros((n, 2)), 0.0, 6.0, rtol=1e-6, atol=1e-8)
        x = np.asarray(sol.xs[0])
        np.testing.assert_allclose(x[:, 0], x[:, 1], atol=1e-12)  # nothing depends on s₂
        errors.append(float(np.max(np.abs(x[:, 0] - profile(strip.points[0][:, 0])))))
        # The free boundary, to the width of a cell.
        assert strip.figures(sol)["heated"] == pytest.approx(2 * sigma, abs=2.0 / n)
    assert errors[1] < 2e-3 and errors[0] / errors[1] > 6.0, errors


def test_thermostat_insulated_plate_gains_the_supplied_heat():
    s1, s2 = plate().points
    load = jnp.asarray(np.exp(-10 * ((s1 - 0.4) ** 2 + (s2 - 0.6) ** 2)))
    model = plate(load=load, upper=jnp.asarray(np.where(s1 < 0.75, 3.0, 0.0)), lower=0.0)
    ts = np.linspace(0.0, 1.0, 201)
    sol = dvax.solve(model.problem, jnp.full((24, 16), 19.0), 0.0, 1.0, ts=ts, dt=1 / 400)
    w = np.asarray(model.space.w)
    heat = (np.asarray(sol.xs) * w).sum(axis=(1, 2))
    gained = ((np.asarray(sol.us) + np.asarray(load)) * w).sum(axis=(1, 2))
    trapezium = 0.5 * np.sum((gained[1:] + gained[:-1]) * np.diff(ts))
    assert heat[-1] - heat[0] == pytest.approx(trapezium, rel=1e-4)
    # No heater, no heat.
    assert np.all(np.asarray(sol.us)[:, 12:] == 0.0) and np.all(np.asarray(sol.us)[0, :12] == 3.0)


def test_thermostat_states_approach_with_the_proved_rate():
    model = plate(boundary="dirichlet", lower=-50.0, upper=50.0, reference=0.0)
    rate = KAPPA * np.pi**2 * (1 / 1.5**2 + 1.0)
    c = model.constants
    assert float(c.sharp_decay_rate) == pytest.approx(rate, rel=1e-12)
    assert float(c.decay_rate) == pytest.approx(rate - GAIN)  # the moduli alone prove nothing
    rng = np.random.default_rng(2)
    ts = np.linspace(0.0, 1.0, 11)
    start = 40.0 * rng.normal(size=(2, 24, 16))
    one, two = (dvax.solve(model.problem, jnp.asarray(x), 0.0, 1.0, ts=ts, dt=0.01) for x in start)
    apart = [float(model.space.norm(a - b)) for a, b in zip(one.xs, two.xs, strict=True)]
    allowed = np.exp(-rate * ts) * apart[0]
    assert np.all(np.array(apart) <= allowed * (1 + 1e-9)) and apart[-1] < 0.5 * allowed[-1]


def test_thermostat_insulated_plate_at_full_power_has_rate_zero():
    model = plate()
    assert float(model.constants.sharp_decay_rate) == pytest.approx(0.0, abs=1e-12)
    cold = [jnp.full((24, 16), value) for value in (5.0, 6.0)]
    ends = [dvax.solve(model.problem, x, 0.0, 2.0, dt=0.01).xs[0] for x in cold]
    assert float(model.space.norm(ends[1] - ends[0])) == pytest.approx(np.sqrt(1.5), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["dirichlet", "neumann", "periodic"])
def test_thermostat_constants_are_proved_by_verify(boundary):
    model = plate(boundary=boundary)
    mine = model.constants
    check = dvax.verify(model.problem, jnp.zeros((24, 16)))
    found = check.constants
    assert check.status == "proved"
    for name in ("gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f", "M", "omega"):
        value = float(getattr(found, name))
        assert float(getattr(mine, name)) == pytest.approx(value, abs=1e-9), name
    assert float(mine.one_sided) <= float(found.one_sided) + 1e-9


def test_thermostat_weights_are_the_areas_of_the_cells():
    model = plate()
    assert float(jnp.sum(model.space.w)) == pytest.approx(1.5)
    s1, s2 = model.points
    assert (s1[0, 0], s2[0, -1]) == (pytest.approx(1.5 / 48), pytest.approx(1 - 1 / 32))


BAD = [
    ("diffusion", 0.0), ("diffusion", -1.0), ("diffusion", "fast"), ("gain", 0.0), ("gain", [1.0, 2.0]),
    ("gain", float("nan")), ("reference", "warm"), ("reference", np.zeros(3)), ("load", float("nan")),
    ("lower", np.zeros((16, 24))), ("lower", 4.0), ("upper", float("nan")), ("shape", (0, 3)),
    ("lengths", -1.0), ("boundary", "open"), ("scheme", "fem"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), BAD)
def test_thermostat_rejects_bad_parameters_by_name(name, value):
    with pytest.raises(dvax.InputError) as caught:
        plate(**{name: value})
    assert name in caught.value.problems[0].place and len(caught.value.problems) == 1


def test_thermostat_reports_all_bad_parameters_at_once():
    with pytest.raises(dvax.InputError) as caught:
        plate(diffusion=-1.0, gain=0.0, reference="warm", load=np.zeros(3), lower=np.zeros(2))
    assert len(caught.value.problems) == 5
