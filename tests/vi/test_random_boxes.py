"""Every solver on random boxes: within 1e-8 of the oracle's solution, or a reported failure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.vi.random_boxes import SIZE, boxes, by_faces, by_pivoting, drawn
from tests.vi.results import reasons, successful

import dvax
from dvax.vi import (
    Auto,
    Extragradient,
    ForwardBackwardForward,
    GoldenRatio,
    Projection,
    SemismoothNewton,
)

COUNT = 1000
# solver, whether it is told L_F, and the least part of the well-conditioned cases that it must solve
SOLVERS = {
    "auto": (Auto(), False, 0.99),
    "newton": (SemismoothNewton(), False, 0.99),
    "extragradient": (Extragradient(max_steps=1500), True, 0.95),
    "forward-backward-forward": (ForwardBackwardForward(max_steps=1500), False, 0.95),
    "golden ratio": (GoldenRatio(max_steps=1500), False, 0.95),
    "projection": (Projection(max_steps=1500), True, 0.3),
}
_compiled = {}


def compiled(name):
    solver, told, _ = SOLVERS[name]

    def one(M, q, lower, upper, gamma, L):
        return dvax.solve_vi(
            lambda y, args: args[0] @ y + args[1], dvax.sets.Box(lower, upper), jnp.zeros(SIZE),
            (M, q), solver=solver, gamma=gamma, L_F=L if told else None, tol=1e-9,
        )  # fmt: skip

    return _compiled.setdefault(name, jax.jit(jax.vmap(one)))


def check(name, seed):
    cases = boxes(seed, COUNT)
    vi = compiled(name)(*map(jnp.asarray, cases[:6]))
    good = successful(vi)
    y, bound = np.asarray(vi.y), np.asarray(vi.error_bound)
    error = np.linalg.norm(y - cases.y, axis=1)
    kind = [
        np.where(cases.gamma > 0.05, "easy", "hard"),
        np.array(["6", "10", "exact"])[cases.family],
    ]
    for both in sorted(set(zip(*kind))):
        here = (kind[0] == both[0]) & (kind[1] == both[1])
        worst = error[here & good].max(initial=0)
        print(
            f"{name}, {' '.join(both)}: {good[here].mean():.3f} of {here.sum()} solved, largest error "
            f"{worst:.1e}; else {reasons(vi, here)}"
        )
    silent = good & ~(error <= 1e-8)
    assert not silent.any(), (np.flatnonzero(silent), error[silent], cases.gamma[silent])
    # Wherever the answer is a point at all it lies in K, and its bound holds: but for the rounding of
    # F, of which a modulus γ makes an error 1/γ times as large.
    assert np.all(np.isfinite(y))
    assert np.all((y >= cases.lower) & (y <= cases.upper))
    size = 1 + np.linalg.norm(cases.y, axis=1) + np.linalg.norm(cases.q, axis=1)
    rounding = 1e-15 * cases.L * size / cases.gamma
    assert np.all(error <= bound + rounding)
    easy = cases.gamma > 0.05
    assert good[easy].mean() >= SOLVERS[name][2]


OFTEN = ("auto",)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in OFTEN else pytest.mark.thorough) for n in SOLVERS],
)
def test_random_boxes_are_solved_or_report_failure(name):
    check(name, seed=1)


@pytest.mark.thorough  # ten thousand boxes for each solver
@pytest.mark.parametrize("name", SOLVERS)
def test_ten_thousand_random_boxes_are_solved_or_report_failure(name):
    for seed in range(2, 12):
        check(name, seed)


def test_random_box_oracles_agree_and_exact_cases_are_exact():
    M, q, lower, upper = drawn(np.random.default_rng(3), 60, 5)
    by_face, by_pivot = by_faces(M, q, lower, upper), by_pivoting(M, q, lower, upper)
    np.testing.assert_allclose(by_face, by_pivot, rtol=0, atol=1e-12)
    cases = boxes(4, 500)
    F = np.einsum("kij,kj->ki", cases.matrix, cases.y) + cases.q
    left = cases.y - np.clip(cases.y - F, cases.lower, cases.upper)
    assert np.abs(left).max() < 1e-13
    exact = cases.family == 2
    assert np.all(left[exact] == 0)
    # All degeneracies are there: F nothing at a bound, no width, no bound, γ of 1e-10.
    held = (cases.y == cases.lower) | (cases.y == cases.upper)
    fixed = cases.lower == cases.upper
    assert np.mean(held & ~fixed & (F == 0)) > 0.01
    assert np.mean(fixed[exact]) > 0.005 and np.mean(np.isinf(cases.upper)) > 0.05
    assert np.mean(cases.gamma < 2e-10) > 0.04
