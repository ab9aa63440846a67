"""Viscoplasticity against closed forms, and against return mappings written with tensors."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.models._stress import BASIS, join, split
from dvax.models.duvaut_lions import DruckerPrager, DuvautLions, VonMises, mandel, tensor

K, G, TAU, STRENGTH = 160.0, 80.0, 0.1, 0.25
RADIUS = np.sqrt(2.0 / 3.0) * STRENGTH
SHEAR = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
TENSION = np.diag([1.0, -0.5, -0.5])
OEDOMETRIC = np.diag([1.0, 0.0, 0.0])

TIMES = np.linspace(0.0, 4.0, 9)
CYCLE = np.array([0.0, 1.0, 2.0, 1.0, 0.0, -1.0, -2.0, -1.0, 0.0]) * 2e-3
# Tension first, then a quarter of a circle towards shear, then back along another way.
_CORNERS = [
    (0, 0, 0), (2, 0, 0), (4, 0, 0), (3.5, 2, 0), (2, 3.5, 0), (0, 4, 1), (-2, 3, 1), (-3, 0, 0),
    (0, 0, 0),
]  # fmt: skip
WINDING = 1e-3 * np.einsum("ka,aij->kij", _CORNERS, np.stack([TENSION, SHEAR, OEDOMETRIC]))


def point(path, tau=TAU, yields=None):
    """A material point led through these strains (tensors) by straight pieces of half a second."""
    strain = dvax.signals.Table(TIMES, mandel(path))
    return DuvautLions(
        bulk=K, shear=G, relaxation=tau, strain=strain, yields=yields or VonMises(STRENGTH)
    )


def led(model, x0=None, **settings):
    options = dict(ts=TIMES, rtol=1e-9, atol=1e-13, method=dvax.ETD4RK()) | settings
    return dvax.solve(model.problem, model.virgin if x0 is None else x0, 0.0, 4.0, **options)


def stresses(model, sol):
    return np.asarray(tensor(jax.vmap(model.stress)(sol.ts, sol.xs)))


def dev(T):
    return T - np.trace(T) / 3 * np.eye(3)


def elastic(e):
    return K * np.trace(e) * np.eye(3) + 2 * G * dev(e)


def radial_return(trial):
    length = np.linalg.norm(dev(trial))
    return trial if length <= RADIUS else trial - (1 - RADIUS / length) * dev(trial)


M, P_T = 0.9, 0.1


def cone_return(trial):
    """The closest point of √(3/2)‖s‖ ≤ M(p + p_t) in σ:C⁻¹:σ, by de Souza Neto, Peric and Owen's
    return with flow along the normal, and to the apex beyond it."""
    p, s = -np.trace(trial) / 3, dev(trial)
    q = np.sqrt(1.5) * np.linalg.norm(s)
    f = q - M * (p + P_T)
    if f <= 0:
        return trial
    flow = f / (3 * G + K * M * M)
    if q - 3 * G * flow >= 0:
        return (1 - 3 * G * flow / q) * s - (p + K * M * flow) * np.eye(3)
    return P_T * np.eye(3)


def rate_independent(path, back, pieces=2000):
    """Stresses at the corners of a path of straight pieces, by increments and returns."""
    found, plastic = [np.zeros((3, 3))], np.zeros((3, 3))
    for one, two in itertools.pairwise(path):
        for k in range(1, pieces + 1):
            trial = elastic(one + (two - one) * (k / pieces) - plastic)
            stress = back(trial)
            gap = trial - stress
            plastic = plastic + dev(gap) / (2 * G) + np.trace(gap) / (9 * K) * np.eye(3)
        found.append(stress)
    return np.array(found)


def random_stresses(count, size=1.0, seed=1):
    T = np.random.default_rng(seed).normal(size=(count, 3, 3)) * size
    return T + np.swapaxes(T, 1, 2)


def test_mandel_vectors_keep_the_inner_product_of_tensors():
    S, T = random_stresses(20), random_stresses(20, seed=2)
    np.testing.assert_allclose(BASIS @ BASIS.T, np.eye(6), atol=1e-15)
    for of in (mandel, lambda A: split(mandel(A))):
        together = np.sum(np.asarray(of(S)) * np.asarray(of(T)), axis=1)
        np.testing.assert_allclose(together, np.einsum("kij,kij->k", S, T), rtol=1e-12)
    np.testing.assert_allclose(np.asarray(tensor(mandel(S))), S, atol=1e-15)
    np.testing.assert_allclose(np.asarray(tensor(join(split(mandel(S))))), S, atol=1e-14)


def test_duvaut_lions_elasticity_is_diagonal_and_its_energy_is_the_norm():
    model = point(WINDING, yields=DruckerPrager(M, P_T))
    e = 1e-4 * random_stresses(1)[0]
    stress = tensor(join(model.moduli * split(mandel(jnp.asarray(e)))))
    np.testing.assert_allclose(np.asarray(stress), elastic(e), atol=1e-14)
    state, control = model.problem.spaces(jnp.zeros(6))
    energy = np.sum(elastic(e) * e)
    assert float(state.norm(split(mandel(e)))) ** 2 == pytest.approx(energy, rel=1e-12)
    s = split(mandel(elastic(e)))
    assert float(control.norm(s)) ** 2 == pytest.approx(energy, rel=1e-12)


@pytest.mark.parametrize(
    ("yields", "back"),
    [(VonMises(STRENGTH), radial_return), (DruckerPrager(M, P_T), cone_return)],
    ids=["von Mises", "Drucker-Prager"],
)
def test_duvaut_lions_projection_is_the_return_mapping(yields, back):
    model = point(WINDING, yields=yields)
    pressures = 0.2 * np.arange(-2, 4).repeat(10)[:, None, None]
    sizes = np.tile(np.linspace(0.01, 0.2, 10), 6)[:, None, None]
    trials = sizes * random_stresses(60) - pressures * np.eye(3)
    expected = np.array([back(T) for T in trials])
    kept = 6 - len(model.virgin)  # of von Mises the pressure is no part of the law
    z, y = (np.asarray(split(mandel(T))) for T in (trials, expected))
    np.testing.assert_allclose(z[:, :kept], y[:, :kept], atol=1e-15)
    z, y = z[:, kept:], y[:, kept:]
    Kset, space = model.problem.set_at(0.0), model.problem.spaces(model.virgin)[1]
    project = jax.jit(jax.vmap(lambda z: Kset.project(z, space)))
    np.testing.assert_allclose(np.asarray(project(jnp.asarray(z))), y, atol=1e-13)
    moved = np.linalg.norm(z - y, axis=1) > 1e-9
    assert moved.any() and not moved.all()
    if back is cone_return:
        apex = np.linalg.norm(expected - P_T * np.eye(3), axis=(1, 2)) < 1e-12
        assert 0 < apex.sum() < moved.sum()
    # And it is the nearest point in the energy: ⟨z − y, v − y⟩ ≤ 0 for all v of the set.
    gaps = (z - y) / np.asarray(model.moduli)[kept:]
    assert np.einsum("ki,kli->kl", gaps, y[None] - y[:, None]).max() <= 1e-13


@pytest.mark.slow
@pytest.mark.parametrize(
    "way",
    [
        pytest.param(SHEAR, marks=pytest.mark.thorough),
        pytest.param(TENSION, marks=pytest.mark.thorough),
        OEDOMETRIC,
    ],
    ids=["shear", "tension", "oedometric"],
)
def test_duvaut_lions_overstress_on_a_straight_path_is_exponential(way):
    # dev σ = s n, and z = s − R obeys z' = 2Gė − z/τ once s has reached R.
    rate = 2e-3
    model = point(rate * TIMES[:, None, None] * way)
    sol = led(model)
    found = stresses(model, sol)
    speed = 2 * G * rate * np.linalg.norm(dev(way))
    start = RADIUS / speed
    assert 0.2 < start < 1.5
    later = np.maximum(TIMES - start, 0.0)
    s = np.minimum(speed * TIMES, RADIUS) + speed * TAU * (1 - np.exp(-later / TAU))
    n = dev(way) / np.linalg.norm(dev(way))
    pressure = K * rate * np.trace(way) * TIMES
    expected = s[:, None, None] * n + pressure[:, None, None] * np.eye(3)
    np.testing.assert_allclose(found, expected, atol=2e-8)
    figures = model.figures(sol)
    assert figures["peak_stress"] == pytest.approx(np.sqrt(1.5) * s[-1], abs=1e-7)
    assert figures["overstress"] == pytest.approx(s[-1] - RADIUS, abs=1e-7)
    plastic = rate * 4.0 * np.linalg.norm(dev(way)) - s[-1] / (2 * G)
    assert figures["plastic_strain"] == pytest.approx(np.sqrt(2 / 3) * plastic, abs=1e-9)


@pytest.mark.thorough
def test_duvaut_lions_overstress_with_decreasing_strength_is_the_closed_form():
    # ‖s‖ = R(t) + z, with R' = −r and z' = r − z/τ from where R meets the stress.
    def strength(t):
        return 0.4 - 0.05 * t

    strain = 1e-3 * np.repeat(SHEAR[None], 9, axis=0)
    model = point(strain, yields=VonMises(strength))
    s0 = 2 * G * 1e-3 * np.sqrt(2.0)
    r = 0.05 * np.sqrt(2 / 3)
    start = (np.sqrt(2 / 3) * 0.4 - s0) / r
    assert 1.0 < start < 3.0
    sol = led(model, ts=[4.0])
    s = np.sqrt(2 / 3) * strength(4.0) + r * TAU * (1 - np.exp(-(4.0 - start) / TAU))
    assert np.linalg.norm(dev(stresses(model, sol)[0])) == pytest.approx(s, abs=2e-8)


@pytest.mark.thorough
def test_duvaut_lions_flow_on_the_cone_dilates_with_exponential_overstress():
    # On the smooth face f = q − M(p + p_t) obeys f' = n·Cε' − f/τ, n = ∂f/∂σ, with a fixed n.
    rate = 2e-3
    model = point(rate * TIMES[:, None, None] * SHEAR, yields=DruckerPrager(M, P_T))
    sol = led(model)
    found = stresses(model, sol)[-1]
    speed = np.sqrt(1.5) * 2 * G * rate * np.sqrt(2.0)
    start = M * P_T / speed
    f = speed * TAU * (1 - np.exp(-(4.0 - start) / TAU))
    flow = (speed * (4.0 - start) - f) / (3 * G + K * M * M)
    p, q = -np.trace(found) / 3, np.sqrt(1.5) * np.linalg.norm(dev(found))
    assert q - M * (p + P_T) == pytest.approx(f, abs=1e-8)
    # What flowed made room: the pressure rises by K times the dilatation M·flow.
    assert p == pytest.approx(K * M * flow, abs=1e-8) and p > 0.1
    plastic = np.asarray(tensor(model.plastic_strain(sol.xs[-1])))
    assert np.trace(plastic) == pytest.approx(M * flow, abs=1e-10)


SQUEEZE = 1.5e-3 * np.eye(3) * np.linspace(0.0, 1.0, 9)[:, None, None]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "yields", "back"),
    [
        (CYCLE[:, None, None] * SHEAR, VonMises(STRENGTH), radial_return),
        pytest.param(
            WINDING, VonMises(STRENGTH), radial_return, marks=pytest.mark.thorough
        ),
        pytest.param(
            WINDING - SQUEEZE, DruckerPrager(M, P_T), cone_return, marks=pytest.mark.thorough
        ),
    ],
    ids=["cycle", "winding", "winding on the cone"],
)  # fmt: skip
def test_duvaut_lions_converges_to_the_return_mapping(path, yields, back):
    limit = rate_independent(path, back)
    errors = []
    for tau in (0.04, 0.02, 0.01):
        model = point(path, tau, yields)
        sol = led(model, rtol=1e-6, atol=1e-9)
        errors.append(np.abs(stresses(model, sol) - limit).max())
    ratios = np.array(errors[:-1]) / errors[1:]
    assert errors[0] < 0.1 and np.all((ratios > 1.7) & (ratios < 2.2)), (errors, ratios)


@pytest.mark.thorough
def test_duvaut_lions_constants_are_proved_by_verify():
    model = point(WINDING)
    mine = model.constants
    check = dvax.verify(model.problem, model.virgin, 0.0, 4.0)
    for name in ("gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f", "M", "omega"):
        value = float(getattr(check.constants, name))
        assert float(getattr(mine, name)) == pytest.approx(value, abs=1e-9), name
    assert check.status == "proved" and float(mine.decay_rate) == pytest.approx(0.0, abs=1e-12)
    assert float(mine.one_sided) <= float(check.constants.one_sided) + 1e-9


@pytest.mark.thorough
def test_duvaut_lions_constants_of_the_cone_are_proved_by_verify():
    model = point(WINDING, yields=DruckerPrager(M, P_T))
    check = dvax.verify(model.problem, model.virgin, 0.0, 4.0)
    assert check.status == "proved"
    for name in ("gamma", "L_F", "alpha_h", "beta_f", "omega"):
        value = float(getattr(check.constants, name))
        assert float(getattr(model.constants, name)) == pytest.approx(value, abs=1e-9), name


@pytest.mark.thorough
def test_duvaut_lions_trajectories_of_one_strain_do_not_separate():
    model = point(WINDING)
    starts = 1e-3 * np.random.default_rng(4).normal(size=(2, 5))
    one, two = (led(model, x0=jnp.asarray(x), rtol=1e-8) for x in starts)
    space = model.problem.spaces(model.virgin)[0]
    apart = [float(space.norm(a - b)) for a, b in zip(one.xs, two.xs, strict=True)]
    assert np.all(np.diff(apart) <= 1e-9) and apart[-1] < 0.8 * apart[0]


@pytest.mark.thorough
def test_duvaut_lions_many_points_are_one_batch():
    ways = np.stack([SHEAR, TENSION, OEDOMETRIC]) * np.array([1.0, 2.0, -1.0])[:, None, None] * 2e-3
    rows = np.asarray(mandel(ways))[:, None, :] * TIMES[:, None]

    def last(rows):
        strain = dvax.signals.Table(TIMES, rows)
        model = DuvautLions(
            bulk=K, shear=G, relaxation=TAU, strain=strain, yields=VonMises(STRENGTH)
        )
        sol = dvax.solve(model.problem, model.virgin, 0.0, 4.0, dt=0.01)
        return model.stress(4.0, sol.xs[-1])

    together = np.asarray(jax.jit(jax.vmap(last))(jnp.asarray(rows)))
    for k in range(3):
        alone = np.asarray(last(jnp.asarray(rows[k])))
        np.testing.assert_allclose(together[k], alone, atol=1e-13)


BAD = [
    ("bulk", 0.0), ("bulk", "stiff"), ("shear", -1.0), ("shear", [1.0, 2.0]), ("relaxation", 0.0),
    ("relaxation", float("inf")), ("strain", np.zeros(5)), ("strain", lambda t: jnp.zeros((3, 3))),
    ("strain", "pull"), ("yields", 0.25), ("yields", VonMises(0.0)), ("yields", VonMises("hard")),
    ("yields", DruckerPrager(0.0, 1.0)), ("yields", DruckerPrager(1.0, -1.0)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), BAD)
def test_duvaut_lions_rejects_bad_parameters_by_name(name, value):
    good = dict(bulk=K, shear=G, relaxation=TAU, strain=np.zeros(6), yields=VonMises(STRENGTH))
    with pytest.raises(dvax.InputError) as caught:
        DuvautLions(**(good | {name: value}))
    assert name in caught.value.problems[0].place and len(caught.value.problems) == 1


def test_duvaut_lions_reports_all_bad_parameters_at_once():
    with pytest.raises(dvax.InputError) as caught:
        DuvautLions(
            bulk=-1.0, shear="soft", relaxation=0.0, strain=np.zeros(5),
            yields=DruckerPrager(-1.0, -1.0),
        )  # fmt: skip
    assert len(caught.value.problems) == 6
