"""Under `jax.vmap` every lane is an independent problem."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.vi.results import reasons, successful

import dvax
from dvax.sets import Box
from dvax.vi import (
    Auto,
    Bracketing,
    Extragradient,
    ForwardBackwardForward,
    GoldenRatio,
    Projection,
    SemismoothNewton,
)

SIZE = 3
SOLVERS = {
    "auto": Auto(), "newton": SemismoothNewton(), "extragradient": Extragradient(),
    "forward-backward-forward": ForwardBackwardForward(), "golden ratio": GoldenRatio(),
    "projection": Projection(max_steps=3000),
}  # fmt: skip


def solve(solver, y0, args, lower, upper):
    def F(y, args):
        M, q, wild = args
        # A lane may have an F that is nowhere a number, or that pushes to infinity.
        return M @ y + 0.1 * y**3 + q + wild

    return dvax.solve_vi(
        F, Box(lower, upper), y0, args, solver, tol=1e-9, gamma=0.5, L_F=3.0
    )  # fmt: skip


def lanes(count):
    rng = np.random.default_rng(4)
    skew = rng.normal(size=(count, SIZE, SIZE)) * 0.3
    M = np.eye(SIZE) + skew - skew.swapaxes(1, 2)
    q = rng.normal(size=(count, SIZE)) * 2
    lower = rng.normal(size=(count, SIZE)) - 1
    upper = lower + rng.exponential(size=(count, SIZE))
    y0 = rng.normal(size=(count, SIZE))
    return y0, (M, q, np.zeros(count)), lower, upper


def same(one, other, lane, atol=0.0):
    for name in ("y", "residual", "error_bound", "iterations", "evaluations"):
        p, q = np.asarray(getattr(one, name))[lane], np.asarray(getattr(other, name))[lane]
        np.testing.assert_allclose(p, q, rtol=0, atol=atol, err_msg=name)


CHEAP = ("auto",)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in CHEAP else pytest.mark.thorough) for n in SOLVERS],
)
def test_solve_vi_lanes_are_independent(name):
    run = jax.jit(
        jax.vmap(lambda *given: solve(SOLVERS[name], *given)),
    )
    y0, (M, q, wild), lower, upper = lanes(8)
    together = run(*map(jnp.asarray, (y0,)), jax.tree.map(jnp.asarray, (M, q, wild)), lower, upper)
    assert successful(together).all()

    # A lane alone: the same program with all lanes equal to it.
    for lane in (0, 5):
        alone = jax.tree.map(
            lambda a, lane=lane: jnp.asarray(np.repeat(a[lane : lane + 1], 8, axis=0)),
            (y0, (M, q, wild), lower, upper),
        )
        same(run(*alone), together, lane)

    # Lanes that fail: F not a number; bounds that leave no point; no bound against a push that grows.
    wild, M, lower, upper = wild.copy(), M.copy(), lower.copy(), upper.copy()
    wild[1] = np.nan
    lower[2], upper[2] = np.inf, -np.inf
    M[3], lower[3], upper[3] = -1e3 * np.eye(SIZE), -np.inf, np.inf
    some = run(jnp.asarray(y0), jax.tree.map(jnp.asarray, (M, q, wild)), lower, upper)
    good = successful(some)
    print(f"{name}: lanes 1, 2, 3 say {[reasons(some, np.arange(8) == k) for k in (1, 2, 3)]}")
    assert not good[[1, 2]].any() and good[[0, 4, 5, 6, 7]].all()
    for lane in (0, 4, 5, 6, 7):
        same(some, together, lane)


def test_solve_vi_pointwise_lanes_are_independent():
    run = jax.jit(
        jax.vmap(
            lambda c, lower, upper: dvax.solve_vi(
                lambda y, c: jnp.expm1(y) + y - c, Box(lower, upper), jnp.zeros(()), c,
                Bracketing(), gamma=1.0,
            )
        )
    )  # fmt: skip
    c, lower, upper = np.array([0.3, -2.0, 5.0, 1.0]), np.full(4, -1.0), np.array([1.0, 1, 9, 1])
    together = run(*map(jnp.asarray, (c, lower, upper)))
    assert successful(together).all()
    wrong = run(*map(jnp.asarray, (np.where(np.arange(4) == 1, np.nan, c), lower, upper)))
    assert list(successful(wrong)) == [True, False, True, True]
    for lane in (0, 2, 3):
        same(wrong, together, lane)


@pytest.mark.thorough  # a program for each
def test_solve_vi_maps_over_one_of_F_K_and_args():
    # F's data, the set's data, or the guess: each lane equals the plain call.
    y0, (M, q, wild), lower, upper = jax.tree.map(jnp.asarray, lanes(2))
    solver = GoldenRatio()
    single = jax.jit(lambda *given: solve(solver, *given).y)
    first = jax.tree.map(lambda a: a[0], (y0, (M, q, wild), lower, upper))
    for mapped in range(4):
        given = [tuple(v) if isinstance(v, tuple) else v for v in first]
        given[mapped] = (y0, (M, q, wild), lower, upper)[mapped]
        axes = tuple(0 if k == mapped else None for k in range(4))
        both = jax.vmap(single, in_axes=axes)(*given)
        for lane in range(2):
            given[mapped] = jax.tree.map(
                lambda a, k=lane: a[k], (y0, (M, q, wild), lower, upper)[mapped]
            )
            np.testing.assert_allclose(both[lane], single(*given), rtol=0, atol=1e-9)
