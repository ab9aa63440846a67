"""A viscoelastic layer under a rough body: closed forms of Westergaard and Hertz, full contact, and the
proved rate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax.models import RoughContact


def wavy(n, approach, **changes):
    """One wave of amplitude 1 on a cell of length 2; E* = 3; the layer is thick."""
    s = np.arange(n) / n
    given = dict(lengths=2.0, modulus=3.0, thickness=20.0, creep=0.5, retardation_time=0.8)
    return RoughContact(profile=np.cos(2 * np.pi * s), approach=approach, **given | changes)


@pytest.mark.slow
@pytest.mark.parametrize("relaxed", mostly_thorough([False, True], [True]))
def test_wavy_surface_has_the_area_of_westergaard(relaxed):
    """p̄ = (πE*Δ/λ) sin²(πa/λ) on the width 2a, for heights Δ(1 − cos 2πs/λ)."""
    model = wavy(512, 8.0)
    modulus = 3.0 / 1.5 if relaxed else 3.0
    for approach in (2.0, 8.0, 14.0):
        figures = model.figures(model.equilibrium(approach, relaxed=relaxed).y)
        width = figures["contact_area"]
        assert 0.0 < width < 1.0
        low, high = (np.sin(0.5 * np.pi * (width + d)) ** 2 for d in (-2 / 512, 2 / 512))
        mean = figures["mean_pressure"] / (np.pi * modulus / 2.0)
        assert low <= mean <= high


@pytest.mark.slow
def test_sphere_has_the_pressure_of_hertz():
    """p₀³ = 6FE*²/(π³R²), with contact on a twelfth of the cell's length."""
    n, radius, modulus = 96, 2.0, 5.0
    s = (np.arange(n) + 0.5) / n - 0.5
    sphere = -(s[:, None] ** 2 + s**2) / (2 * radius)
    model = RoughContact(profile=sphere, lengths=1.0, modulus=modulus, thickness=5.0, approach=0.0)
    vi = model.equilibrium(0.009)
    assert int(vi.evaluations) <= 30 and vi.solver == "ActiveSet"
    force, peak = float(jnp.sum(model.space.w * vi.y)), float(vi.y.max())
    assert 0.002 < float(jnp.mean(vi.y > 0)) < 0.05
    assert peak**3 == pytest.approx(6 * force * modulus**2 / (np.pi**3 * radius**2), rel=0.02)


@pytest.mark.slow
def test_optimality_conditions_hold_at_any_load_and_hardness():
    rng = np.random.default_rng(0)
    for seed in range(4):
        rough = np.cumsum(rng.normal(size=48)) / 7
        model = RoughContact(
            profile=rough, lengths=3.0, modulus=2.0, thickness=0.7, approach=0.0, hardness=1.5
        )
        vi = model.equilibrium(0.4 * (seed + 1), tol=1e-10)
        p = np.asarray(vi.y)
        # The matrix of P⁻¹ by its columns, and the gap to the body.
        inverse = np.stack([np.asarray(model.operator.inverse(e)) for e in jnp.eye(48)], axis=1)
        gap = inverse @ p - (0.4 * (seed + 1) + np.asarray(model.profile))
        assert np.all((p >= 0) & (p <= 1.5)) and np.any(p > 0)
        between = (p > 0) & (p < 1.5)
        assert np.abs(gap[between]).max(initial=0.0) < 1e-8
        assert gap[p == 0].min(initial=0.0) > -1e-8 and gap[p == 1.5].max(initial=0.0) < 1e-8


@pytest.mark.slow
def test_creep_in_full_contact_is_exponential():
    """x = c/(1 + c) (δ + r)(1 − e^{−(1+c)t/τ}) where every point stays in contact."""
    model = wavy(32, 40.0)
    ts = np.array([0.1, 0.7, 2.0])
    sol = dvax.solve(model.problem, model.untouched, 0.0, 2.0, ts=ts, rtol=1e-7, atol=1e-7)
    assert np.all(np.asarray(sol.ys) > 0)
    whole = 0.5 / 1.5 * (40.0 + np.asarray(model.profile))
    for t, state in zip(ts, sol.xs, strict=True):
        np.testing.assert_allclose(model.creep(state), whole * -np.expm1(-1.5 * t / 0.8), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "creep"),
    mostly_thorough([((64,), 0.5), ((64,), 3.0), ((16, 12), 0.5), ((16, 12), 3.0)], [((64,), 0.5)]),
)
def test_pressure_under_a_constant_approach_relaxes_with_its_contact_unchanged(shape, creep):
    """p(t) = λ(t)p(0) and x(t) = (1 − λ(t))P⁻¹p(0), λ = (1 + c e^{−(1+c)t/τ})/(1 + c), for any profile:
    both satisfy the law with the same contact (Lee and Radok)."""
    rough = np.random.default_rng(5).normal(size=shape)
    model = RoughContact(
        profile=rough, lengths=2.0, modulus=3.0, thickness=20.0, approach=8.0, creep=creep,
        retardation_time=0.8,
    )  # fmt: skip
    ts = np.array([0.0, 0.5, 1.0, 4.0])
    sol = dvax.solve(
        model.problem, model.untouched, 0.0, 4.0, ts=ts, rtol=1e-3, atol=1e-3,
        constants=model.constants,
    )  # fmt: skip
    first = model.equilibrium(relaxed=False, tol=1e-12).y
    assert 0.05 < float(jnp.mean(first > 0)) < 0.9
    bound = dvax.bound_error(model.problem, sol, model.constants)
    assert bound.status == "estimated"
    for t, state, p, most in zip(ts, sol.xs, sol.ys, np.asarray(bound.x), strict=True):
        part = (1 + creep * np.exp(-(1 + creep) * t / 0.8)) / (1 + creep)
        exact = model.root.apply((1 - part) * model.operator.inverse(first))
        error = float(model.space.norm(state - exact))
        assert error <= most <= 1e-3 * float(model.space.norm(exact))
        assert float(jnp.max(jnp.abs(p - part * first))) < 1e-2 * float(jnp.max(first))


@pytest.mark.slow
def test_constants_are_those_that_verify_proves():
    model = wavy(24, 6.0)
    check = dvax.verify(model.problem, model.untouched, 0.0, 1.0)
    mine, proved = model.constants, check.constants
    for name in ("gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f", "omega", "m_P"):
        assert float(getattr(mine, name)) == pytest.approx(
            float(getattr(proved, name)), rel=1e-9, abs=1e-12
        ), name
    assert mine.growth_rate > 0 and float(mine.one_sided) == -1 / 0.8


@pytest.mark.slow
def test_trajectories_approach_with_the_proved_rate():
    model, rng = wavy(64, 5.0), np.random.default_rng(1)
    ts = np.linspace(0.0, 3.0, 7)
    ends = [
        dvax.solve(model.problem, jnp.asarray(start), 0.0, 3.0, ts=ts, rtol=1e-6, atol=1e-6).xs
        for start in 2.0 * rng.normal(size=(2, 64))
    ]
    distance = [float(model.space.norm(d)) for d in ends[0] - ends[1]]
    assert np.all(distance <= distance[0] * np.exp(-ts / 0.8) * (1 + 1e-4))


@pytest.mark.thorough
def test_derivative_of_the_load_is_that_of_differences():
    """1,600 unknowns: by the implicit function theorem, without a matrix."""
    rough = np.random.default_rng(2).normal(size=(40, 40))
    model = RoughContact(
        profile=rough, lengths=1.0, modulus=1.0, thickness=3.0, approach=0.0, creep=1.0
    )
    load = lambda approach: jnp.mean(model.equilibrium(approach, tol=1e-12).y)  # noqa: E731
    difference = (load(4.0 + 1e-6) - load(4.0 - 1e-6)) / 2e-6
    assert float(jax.grad(load)(4.0)) == pytest.approx(float(difference), rel=1e-6)


BAD = {
    "profile": (np.zeros((2, 2, 2)), "one or two dimensions"),
    "lengths": ((1.0, 2.0), "a positive number"),
    "modulus": (-1.0, "positive"),
    "thickness": (np.inf, "positive"),
    "approach": (np.nan, "finite number or a function"),
    "creep": (-0.1, "≥ 0"),
    "retardation_time": (0.0, "positive"),
    "hardness": (0.0, "positive"),
}


@pytest.mark.parametrize("name", BAD)
def test_wrong_argument_is_reported_with_place_and_rule(name):
    bad, words = BAD[name]
    right = dict(
        profile=np.zeros(8), lengths=1.0, modulus=1.0, thickness=1.0, approach=1.0, creep=1.0
    )
    with pytest.raises(dvax.InputError) as caught:
        RoughContact(**right | {name: bad})
    assert f"dvax.models.RoughContact({name})" in str(caught.value) and words in str(caught.value)


def test_all_wrong_arguments_are_reported_at_once():
    with pytest.raises(dvax.InputError) as caught:
        RoughContact(**{name: bad for name, (bad, _) in BAD.items()})
    assert all(f"dvax.models.RoughContact({name})" in str(caught.value) for name in BAD)
