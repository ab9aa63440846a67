"""Solves that differ only in numbers share one compiled program, directly or under `jax.jit`."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.sets import Ball, Box, Polyhedron
from dvax.vi import (
    Bracketing,
    Extragradient,
    ForwardBackwardForward,
    FrozenVI,
    GoldenRatio,
    Projection,
    SemismoothNewton,
)

SOLVERS = [
    None, SemismoothNewton(), Extragradient(), ForwardBackwardForward(), GoldenRatio(),
    Projection(), Bracketing(),
]  # fmt: skip


def counted(counts):
    def F(y, target):
        counts.append(y.shape)  # runs when F is traced, never when it is evaluated
        return y + y**3 - target

    return F


# One method in every run stands for all: what is counted lies outside of them.
@pytest.mark.parametrize(
    "solver",
    [pytest.param(s, marks=() if s is None else pytest.mark.thorough) for s in SOLVERS],
    ids=lambda solver: "auto" if solver is None else type(solver).__name__,
)
def test_solve_vi_does_not_retrace_for_other_numbers(solver):
    counts = []
    F, rng = counted(counts), np.random.default_rng(0)
    took, first = [], 0
    for number in range(5):
        y0, target, upper = map(jnp.asarray, rng.normal(size=(3, 4)))
        start = time.perf_counter()
        vi = dvax.solve_vi(
            F, Box(-2.0, jnp.abs(upper)), y0, target, solver=solver, tol=1e-9 / (1 + number),
            gamma=1.0 - 0.1 * number, L_F=13.0 + number,
        )  # fmt: skip
        vi.y.block_until_ready()
        took.append(time.perf_counter() - start)
        first = first or len(counts)
        # What is right is right at every call: nothing of the first is left in the program.
        residual = vi.y - jnp.clip(vi.y - (vi.y + vi.y**3 - target), -2.0, jnp.abs(upper))
        if not isinstance(solver, Projection):  # (which may still be on its way)
            assert float(jnp.max(jnp.abs(residual))) < 1e-8
    print(
        f"first call {took[0]:.2f} s, later {1e3 * np.median(took[1:]):.2f} ms, {first} traces of F"
    )
    assert first > 0 and len(counts) == first


@pytest.mark.thorough  # three programs
def test_solve_vi_compiles_again_for_another_shape_or_set():
    counts = []
    F = counted(counts)
    dvax.solve_vi(F, Box(0.0, 1.0), jnp.zeros(2), jnp.ones(2), GoldenRatio())
    before = len(counts)
    dvax.solve_vi(F, Box(0.0, 1.0), jnp.zeros(3), jnp.ones(3), GoldenRatio())
    assert (3,) in counts[before:]
    before = len(counts)
    dvax.solve_vi(F, Ball(0.0, 1.0), jnp.zeros(3), jnp.ones(3), GoldenRatio())
    assert len(counts) > before


def test_solve_vi_under_jit_traces_once():
    counts = []
    F = counted(counts)
    solve = jax.jit(lambda y0, target, K: dvax.solve_vi(F, K, y0, target).y)
    after = []
    for number in range(4):
        y = solve(jnp.full(2, 0.1 * number), jnp.array([0.5, 9.0 + number]), Box(0.0, 1.0 + number))
        after.append(len(counts))
    assert after == [after[0]] * 4
    assert float(y[1] + y[1] ** 3) == pytest.approx(12.0, rel=1e-12)


def test_solve_vi_differentiates_and_maps_closed_over_values():
    # A closure over a traced number is a new function, not the one compiled before.
    def solution(c):
        return dvax.solve_vi(lambda y, _: y + y**3 - c, Box(-9.0, 9.0), jnp.zeros(())).y

    cs = jnp.array([0.0, 2.0, 10.0])
    ys, slopes = jax.vmap(jax.value_and_grad(solution))(cs)
    np.testing.assert_allclose(ys, [0.0, 1.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(slopes, [1.0, 1 / 4, 1 / 13], rtol=1e-10)


def test_newton_projects_and_evaluates_at_one_place_of_its_program(monkeypatch):
    """Compile time grows with their number. The derivative of the solution traces them twice more, and
    the analysis of F, which compiles nothing, traces F once."""
    counts, places = [], []
    project = Polyhedron.project
    monkeypatch.setattr(
        Polyhedron, "project", lambda *args: places.append("project") or project(*args)
    )
    K = Polyhedron(jnp.array([[1.0, 1.0], [-1.0, 2.0]]), jnp.array([1.0, 0.5]))
    F = counted(counts)
    vi = FrozenVI(lambda y: F(y, jnp.ones(2)), K, dvax.spaces.Euclidean(2))
    jax.make_jaxpr(lambda y0: SemismoothNewton().solve(vi, y0, 1e-10).residual)(jnp.zeros(2))
    assert len(places) <= 3 and len(counts) <= 4


@pytest.mark.slow
def test_newton_from_a_solution_ends_after_two_evaluations():
    """The first finds F at the solution and its face, the second the certificate."""
    K = Polyhedron(jnp.array([[1.0, 1.0], [-1.0, 2.0]]), jnp.array([1.0, 0.5]))
    solved = lambda y0: dvax.solve_vi(counted([]), K, y0, jnp.ones(2), SemismoothNewton())  # noqa: E731
    first = solved(jnp.array([5.0, -3.0]))
    again = solved(first.y)
    assert int(again.evaluations) == int(again.iterations) == 2
    np.testing.assert_allclose(again.y, first.y, atol=1e-12)
