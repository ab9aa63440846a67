"""Section 6: its formulas against their definition, and against pairs of trajectories."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import dvax
from dvax.theory import formulas
from dvax.vi import residual_bound

C = dvax.Constants(
    gamma=0.8, L_F=3.0, alpha_h=1.7, beta_h=0.4, alpha_f=0.6, beta_f=1.2, M=2.0, omega=-0.7, m_P=0.5,
    norm_P_inv=1.4, one_sided=-0.2, status="proved",
)  # fmt: skip
GIVEN = dict(T=1.5, kappa_K=0.3, C_h0=0.9, C_f0=1.1, modulus_f=0.7, modulus_h=0.5)
BOUNDS = dvax.ParameterBounds(C, **GIVEN, status="proved")


def phi(a, T):
    return quad(lambda s: np.exp(a * (T - s)), 0.0, T)[0]


def test_section_6_formulas_agree_with_their_definition():
    """Written out once more from the paper, with numbers instead of attributes."""
    L = 1.7 * 1.4 / 0.8
    L_tilde = 0.6 + 1.2 * L
    rate = -0.7 + 2.0 * L_tilde
    radius = lambda R: 1.4 * (0.3 + (1.7 * R + 0.9 + (2 * 1.4 + 3.0) * 0.3) / 0.8)  # noqa: E731
    of_state = 1.0 * (2.0 * 0.25 + 2.0 * (1.2 * radius(0.0) + 1.1) * phi(0.7, 1.5))
    of_state *= np.exp(2.0 * L_tilde * 1.5)
    theta = (1.2 * 1.4 / 0.8 * 0.5 + 0.7) * 0.02
    state = 2.0 * np.exp(rate * 1.5) * 0.01 + 2.0 * phi(rate, 1.5) * theta
    sharp = 1.0 * 0.01 + phi(-0.2, 1.5) * theta
    control = lambda gap: 1.4 / 0.8 * (1.7 * gap + 0.5 * 0.02)  # noqa: E731
    for found, wanted in (
        (BOUNDS.L, L),
        (BOUNDS.L_tilde, L_tilde),
        (BOUNDS.response_radius(2.0), radius(2.0)),
        (BOUNDS.state_radius(0.25), of_state),
        (BOUNDS.radius(0.25), max(of_state, radius(of_state))),
        (BOUNDS.response(0.4, 0.02), control(0.4)),
        (BOUNDS.modulus(0.02), theta),
        (BOUNDS.state(0.01, 0.02), state),
        (BOUNDS.control(0.01, 0.02), control(state)),
        (BOUNDS.sharp_state(0.01, 0.02), sharp),
        (BOUNDS.sharp_control(0.01, 0.02), control(sharp)),
    ):
        assert float(found) == pytest.approx(wanted, rel=1e-12)
    assert BOUNDS.status == "proved"


def test_section_6_functions_agree_with_their_definition():
    for a in (-3.0, -1e-9, 0.0, 1e-320, 1e-9, 2.0):
        assert float(formulas.growth_integral(a, 1.3)) == pytest.approx(phi(a, 1.3), rel=1e-12)
    low, high = formulas.bielecki_equivalence(2.0, 1.5)
    v, ts = np.cos(np.linspace(0.0, 9.0, 400)), np.linspace(0.0, 1.5, 400)
    weighted = np.max(np.exp(-2.0 * ts) * np.abs(v))
    assert low * np.abs(v).max() <= weighted <= high * np.abs(v).max()
    a, b = formulas.continuity_coefficients(1.1, 0.2, 0.3, 0.4, 3.0)
    assert (a, b) == pytest.approx((1.1 * 0.5 + 6.0 * 0.09, 3.0 * 0.3 + 0.4))
    largest = (b + np.sqrt(b * b + 4 * 0.8 * a)) / (2 * 0.8)  # the root of γs² = a + bs
    assert largest <= formulas.quadratic_root(a, b, 0.8)
    assert formulas.frozen_difference(0.6, 0.8) == pytest.approx(0.75)
    assert residual_bound(0.1, 1.0, 0.8, 3.0) == pytest.approx(((3.0 + 1.0) / 0.8 + 1.0) * 0.1)


def test_continuous_dependence_constants_agree_with_their_definition():
    L, L_tilde = 1.7 * 1.4 / 0.8, 0.6 + 1.2 * 1.7 * 1.4 / 0.8
    rate = -0.7 + 2.0 * L_tilde
    assert float(C.separation(0.5)) == pytest.approx(2.0 * np.exp(rate * 0.5))
    assert float(C.response_separation(0.5)) == pytest.approx(2.0 * L * np.exp(rate * 0.5))
    assert float(C.largest_separation(0.5)) == pytest.approx(2.0 * np.exp(max(rate, 0.0) * 0.5))
    assert float(C.sharp_separation(0.5)) == pytest.approx(np.exp(-0.1))
    assert C.smallness == pytest.approx((0.5 - 0.4 * 1.4, 1.4 * 1.4))
    # The best λ against a search.
    factor = lambda lam: np.exp(lam * 1.5) / (1.0 - float(C.bielecki_factor(lam)))  # noqa: E731
    best = float(C.best_lambda(1.5))
    grid = np.linspace(rate + 1e-3, rate + 10.0, 500)
    assert factor(best) <= min(map(factor, grid)) * (1 + 1e-9)
    assert 0.0 < float(C.bielecki_factor(best)) < 1.0


def test_response_in_time_satisfies_its_lipschitz_bound():
    """For a rotating half-plane and a monotone law: the Lipschitz bound and the paper's square root."""
    rng = np.random.default_rng(2)
    J = np.array([[2.0, -1.0], [1.0, 1.0]])
    gamma, L_F = np.linalg.eigvalsh(0.5 * (J + J.T))[0], np.linalg.norm(J, 2)
    space = dvax.spaces.Euclidean(2)

    def solve(t, x):
        K = dvax.sets.Ball(jnp.array([jnp.cos(t), jnp.sin(2 * t)]), 0.4)
        F = lambda y, args: J @ y - jnp.array([1.0, -1.0]) * jnp.sin(t) - x  # noqa: E731
        y = dvax.solve_vi(F, K, jnp.zeros(2), tol=1e-12, space=space).y
        return y, jnp.linalg.norm(F(y, None))

    run = jax.jit(solve)
    worst = 0.0
    for _ in range(60):
        t1, t2 = np.sort(rng.uniform(0.0, 3.0, 2))
        t2 = t1 + (t2 - t1) * 10.0 ** rng.uniform(-4, 0)
        x1 = rng.normal(size=2)
        x2 = x1 + 0.1 * (t2 - t1) * rng.normal(size=2)
        (y1, push), (y2, _) = run(t1, x1), run(t2, x2)
        gap, gap_x = float(jnp.linalg.norm(y1 - y2)), np.linalg.norm(x1 - x2)
        # The centre moves at ≤ √5, the drive at ≤ √2.
        moves = dict(speed_K=np.sqrt(5.0), speed_h=np.sqrt(2.0), alpha_h=1.0, gap_x=gap_x,
                     gap_t=t2 - t1, gamma=gamma, L_F=L_F)  # fmt: skip
        sharp = formulas.response_in_time(**moves)
        paper = formulas.response_in_time_sqrt(float(push), **moves)
        assert gap <= sharp + 1e-9 and gap <= paper + 1e-9
        worst = max(worst, gap / sharp)
        if t2 - t1 < 1e-3:
            assert sharp < paper
    assert worst > 0.05


def test_parameter_bounds_reject_invalid_numbers():
    with pytest.raises(dvax.InputError, match=r"kappa_K.*≥ 0"):
        dvax.ParameterBounds(C, **{**GIVEN, "kappa_K": -1.0})


def contact(eta):
    """The contact law with its data as parameters: (ℓ, d_x, g, b_x)."""
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, p: p[0] - p[1] * x - u,
        h=lambda t, x, u, p: p[2] * jnp.cos(t) - p[3] * x - u,
    )


@pytest.mark.thorough
def test_parameter_bounds_hold_for_pairs_of_trajectories():
    low, high = jnp.array([2.5, 0.4, 0.8, 1.5]), jnp.array([3.5, 0.6, 1.2, 2.5])
    problem = contact(None)
    bounds = dvax.parameter_bounds(problem, low, high, t1=2.0, start_radius=2.0)
    assert bounds.status == "proved"
    c = bounds.constants
    # Uniform over the box, by hand.
    assert float(c.alpha_f) == pytest.approx(0.6) and float(c.alpha_h) == pytest.approx(2.5)
    assert float(c.gamma) == pytest.approx(2.0) and float(bounds.C_f0) == pytest.approx(3.5)
    # −(1 + d_x − b_x/2) at the worst corner of the box.
    assert -(1.0 + 0.4 - 1.25) <= float(c.one_sided) <= 0.5
    R = float(bounds.radius(2.0))
    ts = jnp.linspace(0.0, 2.0, 41)
    run = jax.jit(
        jax.vmap(
            lambda x, p: (lambda s: (s.xs, s.us))(
                dvax.solve(problem, x, 0.0, 2.0, p, ts=ts, dt=1 / 256)
            )
        )
    )
    rng = np.random.default_rng(3)
    n = 1000
    etas = np.asarray(low) + rng.random((2, n, 4)) * np.asarray(high - low)
    near = rng.random(n) < 0.5
    etas[1] = np.where(near[:, None], etas[0] + 1e-2 * (etas[1] - etas[0]), etas[1])
    starts = rng.uniform(-2.0, 2.0, (2, n))
    starts[1] = np.where(near, starts[0] + 1e-2 * rng.normal(size=n), starts[1])
    starts = np.clip(starts, -2.0, 2.0)
    (xs, us), (zs, vs) = run(starts[0], etas[0]), run(starts[1], etas[1])
    assert float(jnp.max(jnp.abs(xs))) <= float(bounds.state_radius(2.0))
    assert float(jnp.max(jnp.abs(us))) <= R
    dx, du = (np.abs(np.asarray(a - b)).max(axis=1) for a, b in ((xs, zs), (us, vs)))
    d_start, d_eta = np.abs(starts[0] - starts[1]), np.linalg.norm(etas[0] - etas[1], axis=1)
    slack = 1e-5
    assert np.all(dx <= np.asarray(bounds.state(d_start, d_eta)) + slack)
    assert np.all(du <= np.asarray(bounds.control(d_start, d_eta)) + slack)
    sharp = np.asarray(bounds.sharp_state(d_start, d_eta))
    assert np.all(dx <= sharp + slack)
    assert np.all(du <= np.asarray(bounds.sharp_control(d_start, d_eta)) + slack)
    assert np.all(sharp <= np.asarray(bounds.state(d_start, d_eta)) * (1 + 1e-12))


def test_parameter_bounds_reject_parameters_in_A_P_and_K():
    moving = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        K=lambda t, p: dvax.sets.Box(0.0, p), f=lambda t, x, u, p: p - u, h=lambda t, x, u, p: -x - u,
    )  # fmt: skip
    with pytest.raises(dvax.InputError, match=r"Problem\(K\).*keeps A, P and K fixed"):
        dvax.parameter_bounds(moving, 1.0, 2.0)
    with pytest.raises(dvax.InputError, match="low ≤ high"):
        dvax.parameter_bounds(contact(None), jnp.ones(4), jnp.zeros(4))
    # ∂f/∂d_x = x is not bounded without a bound on x.
    with pytest.raises(dvax.InputError, match="start_radius"):
        dvax.parameter_bounds(contact(None), jnp.zeros(4), jnp.ones(4))
