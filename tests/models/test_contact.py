"""The contact law against the formulas of Section 7 of the paper, coded independently."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvax

GOOD = dict(alpha=1.3, beta=0.7, b_x=2.0, b_u=0.4, d_x=0.5, d_u=1.1, kappa0=0.6)


def build(**changed):
    return dvax.models.Contact(**{**GOOD, "g": 1.0, "ell": 3.0, **changed})


def test_contact_constants_are_those_of_section_7():
    rng = np.random.default_rng(1)
    for _ in range(20):
        p = {name: float(rng.exponential() + 0.05) for name in GOOD}
        c = build(**p).constants
        gamma = (1 + p["b_u"]) / p["beta"]
        L = p["b_x"] / (1 + p["b_u"])
        L_tilde = p["d_x"] + p["d_u"] * p["b_x"] / (1 + p["b_u"])
        T = 1.7
        expected = {
            "gamma": gamma, "L_F": gamma, "alpha_h": p["b_x"], "alpha_f": p["d_x"],
            "beta_f": p["d_u"], "M": 1.0, "omega": -p["alpha"], "L": L, "L_tilde": L_tilde,
            "decay_rate": p["alpha"] - L_tilde,
        }  # fmt: skip
        for name, value in expected.items():
            assert float(getattr(c, name)) == pytest.approx(value, rel=1e-12, abs=1e-12), name
        C_T = np.exp(max(L_tilde - p["alpha"], 0) * T) * (1 + L)  # eq:concrete_CT
        assert float(c.hadamard(T)) == pytest.approx(C_T, rel=1e-12)
        # With ρ = β the factor of the projection route is b_u itself.
        assert float(c.contraction_factor(p["beta"])) == pytest.approx(p["b_u"], rel=1e-12)
        assert c.status_of("gamma", "L_F", "one_sided") == "proved"


def test_contact_constants_agree_with_those_of_its_problem():
    model = build()
    plane = dvax.spaces.Euclidean(2)
    spectrum = model.problem.operator().spectrum(plane)
    assert float(spectrum.norm_P_inv) == pytest.approx(float(model.constants.norm_P_inv))
    assert float(model.problem.generator().growth(plane).omega) == float(model.constants.omega)


def test_contact_pressure_regimes_and_residual_for_many_drives():
    model = build(g=np.linspace(-3.0, 3.0, 41), ell=0.0)
    x = np.linspace(1.0, -1.0, 41)
    q = np.linspace(-3.0, 3.0, 41) - 2.0 * x
    slope = 0.7 / 1.4
    pressure = np.array([min(max(slope * v, 0.0), 0.6) for v in q])
    regime = [0 if v <= 0 else 2 if v >= 0.6 / slope else 1 for v in q]
    assert set(regime) == {0, 1, 2}
    at = jnp.asarray(x)
    np.testing.assert_allclose(np.asarray(model.drive(0.0, at)), q, atol=1e-14)
    np.testing.assert_allclose(np.asarray(model.pressure(0.0, at)), pressure, atol=1e-14)
    assert np.asarray(model.regimes(0.0, at)).tolist() == regime
    # The law of the problem gives the same: p = βu.
    u = np.asarray(model.problem.response(0.0, at))
    np.testing.assert_allclose(0.7 * u, pressure, atol=1e-14)
    for tau in (0.1, 1.0, 7.0):
        zero = np.asarray(model.residual(tau, 0.0, at, jnp.asarray(pressure)))
        np.testing.assert_allclose(zero, 0.0, atol=1e-13)
        y = np.linspace(-0.2, 0.9, 41)
        F = 1.4 / 0.7 * y - q
        expected = y - np.clip(y - tau * F, 0.0, 0.6)
        found = np.asarray(model.residual(tau, 0.0, at, jnp.asarray(y)))
        np.testing.assert_allclose(found, expected, atol=1e-13)


def test_contact_regime_boundaries_belong_to_unloaded_and_saturated():
    model = build(g=0.0, b_x=1.0, beta=1.0, b_u=1.0, kappa0=0.5)
    # q = −x, saturation at q = 1.
    assert [int(model.regimes(0.0, x)) for x in (0.0, -0.5, -1.0)] == [0, 1, 2]


def test_contact_rate_is_that_of_eq_concrete_state():
    model = build(g=lambda t: jnp.sin(t), ell=lambda t: 2.0 * t)
    t, x = 0.8, 0.1
    u = min(max((np.sin(t) - 2.0 * x) / 1.4, 0.0), 0.6 / 0.7)
    assert float(model.problem.reduced(t, x)) == pytest.approx(2 * t - 0.5 * x - 1.1 * u, abs=1e-14)


@pytest.mark.slow
def test_contact_solution_does_not_depend_on_the_units():
    # Indentation in mm instead of m, pressure in kPa instead of MPa, time in min instead of s.
    X, P, T = 1e3, 1e3, 1 / 60
    t1 = 4.0
    g, ell = lambda t: 1.0 + jnp.sin(3 * t), lambda t: 2.0 * jnp.cos(t)
    model = build(g=g, ell=ell)
    other = build(
        alpha=GOOD["alpha"] / T, d_x=GOOD["d_x"] / T, d_u=GOOD["d_u"] / T,
        beta=GOOD["beta"] * P / X, kappa0=GOOD["kappa0"] * P,
        g=lambda t: X * g(t / T), ell=lambda t: X / T * ell(t / T),
    )  # fmt: skip
    ts, settings = np.linspace(0, t1, 9), {"dt": t1 / 256}
    a = dvax.solve(model.problem, -0.4, 0.0, t1, ts=ts, **settings)
    b = dvax.solve(other.problem, -0.4 * X, 0.0, t1 * T, ts=ts * T, dt=settings["dt"] * T)
    np.testing.assert_allclose(np.asarray(b.xs) / X, np.asarray(a.xs), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(np.asarray(b.ys) / P, np.asarray(a.ys), rtol=1e-10, atol=1e-12)
    for mine, theirs in ((model, other),):
        assert float(mine.constants.L) == pytest.approx(float(theirs.constants.L))
        assert float(theirs.constants.decay_rate) == pytest.approx(
            float(mine.constants.decay_rate) / T
        )
    regimes = [[int(m.regimes(s * t, x)) for t, x in zip(ts, v, strict=True)]
               for m, s, v in ((model, 1.0, a.xs), (other, T, b.xs))]  # fmt: skip
    assert regimes[0] == regimes[1] and len(set(regimes[0])) > 1


BAD = [
    ("alpha", 0.0), ("alpha", -1.0), ("beta", 0.0), ("b_x", -2.0), ("b_u", -0.1), ("d_x", 0.0),
    ("d_u", float("nan")), ("kappa0", float("inf")), ("kappa0", -0.5), ("alpha", [1.0, 2.0]),
    ("beta", "soft"), ("g", float("nan")), ("ell", "heavy"), ("weights", [1.0, -1.0]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), BAD)
def test_contact_rejects_bad_parameters_by_name(name, value):
    with pytest.raises(dvax.InputError) as caught:
        build(**{name: value})
    assert name in caught.value.problems[0].place and len(caught.value.problems) == 1


def test_contact_reports_all_bad_parameters_at_once():
    bad = {name: value for name, value in BAD if name != "weights"} | {"weights": [0.0]}
    with pytest.raises(dvax.InputError) as caught:
        build(**bad)
    text = str(caught.value)
    for name in bad:
        assert name in text
    assert len(caught.value.problems) == len(bad)


def test_contact_accepts_zero_and_large_self_feedback():
    # b_u ≥ 1 is beyond the projection route (q_ρ = b_u), and the law is solved all the same.
    for b_u in (0.0, 5.0):
        model = build(b_u=b_u)
        q = 1.0 - 2.0 * 0.2
        assert float(model.problem.response(0.0, 0.2)) == pytest.approx(q / (1 + b_u))


def test_contact_points_have_their_weights():
    w = np.array([0.5, 2.0, 0.25])
    model = build(weights=w, g=np.array([1.0, 2.0, 3.0]))
    x = np.array([1.0, -1.0, 2.0])
    found = float(model.problem.spaces(jnp.asarray(x))[0].norm(jnp.asarray(x)))
    assert found == pytest.approx(np.sqrt(np.sum(w * x * x)))
