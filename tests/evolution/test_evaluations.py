"""The initial guess of the solver of an iterated law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.evolution.evaluations import _along_line
from dvax.vi import SemismoothNewton


def test_law_guess_interpolates_linearly_between_neighbouring_times():
    """The guess is exact for affine functions between known times, and the nearest value outside."""
    # Of an affine function everything between two known times is exact; outside, the nearest is.
    value = lambda t: (np.array([2.0, -1.0]) * t, 3.0 - t)  # noqa: E731
    rng = np.random.default_rng(1)
    for order in [rng.permutation([0.0, 0.25, 0.5, 0.5, 1.0]) for _ in range(8)]:
        times = np.array([*order, 0.45])
        table = tuple(map(np.stack, zip(*map(value, times), strict=True)))
        for k in range(1, len(times)):
            unknown = [np.where(np.arange(6).reshape(-1, *[1] * (a.ndim - 1)) < k, a, np.nan)
                       for a in table]  # fmt: skip
            known, t = times[:k], times[k]
            at = np.clip(t, known.min(), known.max())
            found = _along_line(jnp.asarray(times), tuple(map(jnp.asarray, unknown)), k)
            for one, other in zip(found, value(at), strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-15, atol=1e-15)


def test_law_guess_takes_the_latest_of_several_values_at_one_time():
    times = jnp.array([0.0, 1.0, 1.0, 1.0])
    rows = jnp.array([0.0, 1.0, 2.0, jnp.nan])
    assert float(_along_line(times, rows, 3)) == 2.0


@pytest.mark.thorough
def test_responses_at_saved_times_do_not_depend_on_the_guess():
    rng = np.random.default_rng(0)
    M = rng.normal(size=(8, 8))
    M, q = jnp.asarray(M @ M.T / 8 + 0.5 * np.eye(8)), jnp.asarray(rng.normal(size=8))
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Simplex(2.0), f=lambda t, x, u, args: u,
        h=lambda t, x, u, args: x + q * jnp.cos(3 * t) - M @ u,
    )  # fmt: skip
    solver = SemismoothNewton()
    ts = np.array([0.0, 0.1, 0.5, 0.77, 1.0])
    sol = dvax.solve(problem, jnp.zeros(8), 0.0, 1.0, ts=ts, vi_solver=solver, dt=0.2)
    respond = jax.jit(jax.vmap(lambda t, x: problem.response(t, x, solver=solver)))
    again = respond(sol.ts, sol.xs)
    np.testing.assert_allclose(sol.us, again, atol=1e-9)
