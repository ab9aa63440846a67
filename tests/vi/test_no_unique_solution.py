"""(2 + sin y)y − q with an additive drive is not pseudomonotone and has three solutions.

A solver finds one of the three, and must not report it as the only one.
"""

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

END = 1.5 * np.pi
DRIVE = 5.577190427585528
THREE = np.array([1.8911306156075787, 3.617780504042352, END])
SOLVERS = [
    Auto(), SemismoothNewton(), Extragradient(), ForwardBackwardForward(), GoldenRatio(),
    Projection(max_steps=2000), Bracketing(),
]  # fmt: skip


def law(y, q):
    return (2.0 + jnp.sin(y)) * y - q


def test_additive_drive_has_three_solutions_and_is_not_pseudomonotone():
    F = lambda y: (2.0 + np.sin(y)) * y - DRIVE  # noqa: E731
    np.testing.assert_allclose(F(THREE[:2]), 0.0, atol=1e-14)
    assert F(END) < 0  # held by the upper bound
    y = np.linspace(0, END, 100_001)
    changes = np.flatnonzero(np.sign(F(y[:-1])) != np.sign(F(y[1:])))
    assert len(changes) == 2  # and no other root
    # Pseudomonotone would be: F(a)(b − a) ≥ 0 ⇒ F(b)(b − a) ≥ 0. At a = y₁, b = y₂ + 1/2 it fails.
    a, b = THREE[0], THREE[1] + 0.5
    assert F(a) * (b - a) >= -1e-13 and F(b) * (b - a) < 0


@pytest.mark.parametrize(
    "solver",
    [pytest.param(s, marks=() if isinstance(s, Auto) else pytest.mark.thorough) for s in SOLVERS],
    ids=lambda s: type(s).__name__,
)
def test_solve_vi_returns_one_of_three_solutions_without_a_bound(solver):
    starts = np.random.default_rng(0).uniform(-1, END + 1, 200)
    vi = jax.jit(
        jax.vmap(
            lambda y0: dvax.solve_vi(law, Box(0.0, END), y0, DRIVE, solver, tol=1e-11)
        )
    )(jnp.asarray(starts))  # fmt: skip
    good = successful(vi)
    distance = np.abs(np.asarray(vi.y)[:, None] - THREE).min(axis=1)
    which = np.abs(np.asarray(vi.y)[:, None] - THREE).argmin(axis=1)
    print(
        f"{type(solver).__name__}: {np.bincount(which[good], minlength=3)} of the three, ", end=""
    )
    print(f"else {reasons(vi, ~good)}")
    assert np.all(distance[good] < 1e-9)
    assert good.any()
    assert vi.error_bound is None  # a bound on ‖y − y*‖ would say that there is one y*


def test_solve_vi_without_a_modulus_has_no_error_bound():
    for start in (0.0, 2.0, 4.7):
        vi = dvax.solve_vi(law, Box(0.0, END), jnp.asarray(start), DRIVE)
        assert vi.error_bound is None
        assert bool(successful(vi)) and np.abs(float(vi.y) - THREE).min() < 1e-9
