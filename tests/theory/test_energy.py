"""Norms in which trajectories approach: the rates hold, independently of the solver."""

import builtins

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import ALL
from tests.selection import mostly_thorough

import dvax
from dvax.theory import energy


def sheared(n, m, seed, pointwise):
    """A stable nonnormal matrix, and a law with weak feedback."""
    rng = np.random.default_rng(seed)
    A = np.diag(-rng.uniform(0.5, 2.0, n)) + np.triu(4.0 * rng.normal(size=(n, n)), 1)
    F_u, H_x = 0.2 * rng.normal(size=(n, m)), 0.2 * rng.normal(size=(m, n))
    root = rng.normal(size=(m, m))
    P = rng.uniform(0.5, 2.0, m) if pointwise else root @ root.T + np.eye(m)
    return dvax.Problem(
        A=dvax.generators.Dense(A),
        P=dvax.operators.Diagonal(P) if pointwise else dvax.operators.Dense(P),
        K=dvax.sets.Box(-0.3, 0.3),
        f=lambda t, x, u, args: jnp.sin(3 * t) + F_u @ u,
        h=lambda t, x, u, args: H_x @ x - 0.1 * u,
        state_space=dvax.spaces.Euclidean(n),
        control_space=dvax.spaces.Euclidean(m),
    )


SIZES = [(2, 2, True), (3, 2, False), (5, 3, True)]


@pytest.mark.thorough
@pytest.mark.parametrize(("n", "m", "pointwise"), mostly_thorough(SIZES, {(2, 2, True)}))
def test_energy_norm_bounds_the_distance_of_trajectories(n, m, pointwise):
    rng = np.random.default_rng(9)
    better = 0
    for seed in range(4):
        problem = sheared(n, m, seed, pointwise)
        c = dvax.verify(problem, jnp.zeros(n), 0.0, 6.0, energy=True).constants
        assert c.energy is not None and dict(c.statuses)["energy"] == "proved"
        M, rate = map(float, c.energy)
        better += rate < float(c.one_sided) - 0.1
        ts = jnp.linspace(0.0, 6.0, 25)
        starts = jnp.asarray(rng.normal(size=(12, n)))
        run = jax.jit(jax.vmap(lambda x: dvax.solve(problem, x, 0.0, 6.0, ts=ts, dt=1 / 64).xs))  # noqa: B023
        xs = np.asarray(run(starts))
        gaps = np.linalg.norm(xs[::2] - xs[1::2], axis=-1)
        assert np.all(gaps <= M * np.exp(rate * np.asarray(ts)) * gaps[:, :1] * (1 + 1e-3) + 1e-6)
    assert better >= 3


@pytest.mark.slow
def test_energy_norm_proves_decay_where_moduli_give_growth():
    problem = sheared(3, 2, 0, True)
    c = dvax.verify(problem, jnp.zeros(3), 0.0, 6.0, energy=True).constants
    assert float(c.decay_rate) < 0 and float(c.sharp_decay_rate) < 0 and float(c.energy[1]) < 0
    ts = np.linspace(0.0, 6.0, 13)[1:]
    sol = dvax.solve(problem, jnp.ones(3), 0.0, 6.0, ts=ts, rtol=1e-6)
    reference = dvax.solve(
        problem, jnp.ones(3), 0.0, 6.0, ts=ts, rtol=1e-9, method=dvax.DormandPrince()
    )
    error = np.linalg.norm(np.asarray(sol.xs - reference.xs), axis=1)
    bound = dvax.bound_error(problem, sol, c)
    assert np.all(error <= np.asarray(bound.x) + 1e-9)
    assert float(bound.x[-1]) < 0.1 * float(bound.x_paper[-1])
    names = {row.name: row for row in c.table()}
    assert names["energy_rate"].value > 0


@pytest.mark.thorough
def test_energy_norm_growth_is_at_most_that_of_the_space_norm():
    for name in ("C1", "C2", "C3"):
        case = ALL[name]()
        c = dvax.verify(
            case.problem, jnp.asarray(case.x0), 0.0, case.t1, case.args, energy=True
        ).constants
        M, rate = map(float, c.energy)
        grown = lambda M, r, T=case.t1: M * np.expm1(r * T) / r  # noqa: E731
        assert grown(M, rate) <= grown(1.0, float(c.one_sided)) * (1 + 1e-6)


def test_energy_norm_rate_is_recomputed_from_the_proposed_norm():
    """For any Q and multipliers, the returned rate is the one that they have."""
    rng = np.random.default_rng(1)
    G, F_u, H_x = rng.normal(size=(3, 3)) - 2 * np.eye(3), rng.normal(size=(3, 2)), np.ones((2, 3))
    data = energy._Data(G, F_u, H_x, np.diag([1.0, 2.0]), np.eye(2), True)
    root = rng.normal(size=(3, 3))
    found = energy._certify(root @ root.T + np.eye(3), np.array([0.7, 0.2]), data)
    form = energy._form(found.Q, np.array([0.7, 0.2]), data, found.rate)
    assert np.linalg.eigvalsh(form)[-1] <= 1e-9
    assert (
        np.linalg.eigvalsh(energy._form(found.Q, np.array([0.7, 0.2]), data, found.rate - 1e-3))[-1]
        > 0
    )
    assert energy._certify(np.diag([1.0, 1.0, -1.0]), np.ones(2), data) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("f", "h", "size", "reason"),
    [
        (lambda t, x, u, args: x * u, lambda t, x, u, args: 1.0 - u, 2, "∂f/∂x, ∂f/∂u are not"),
        (lambda t, x, u, args: -u, lambda t, x, u, args: jnp.sin(x) - u, 2, "∂h/∂x are not"),
        (lambda t, x, u, args: -u, lambda t, x, u, args: x - u, 21, "more than 40 unknowns"),
        (lambda t, x, u, args: -u, lambda t, x, u, args: x + 2.0 * u, 2, "no constants"),
    ],
)
def test_verification_says_why_there_is_no_energy_norm(f, h, size, reason):
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), f=f, h=h,
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
    )  # fmt: skip
    check = dvax.verify(problem, jnp.zeros(size), x=(-2.0, 2.0), energy=True)
    assert reason in check.no_energy and check.no_energy in repr(check)
    assert check.constants is None or check.constants.energy is None


def test_energy_norm_without_the_solver_names_the_extra(monkeypatch):
    real = builtins.__import__

    def without(name, *given, **more):
        if name == "clarabel":
            raise ModuleNotFoundError(name)
        return real(name, *given, **more)

    case = ALL["C1"]()
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(dvax.InputError, match=r"pip install 'dvax\[energy\]'"):
        dvax.verify(case.problem, jnp.asarray(-1.0), 0.0, 2.0, case.args, energy=True)
