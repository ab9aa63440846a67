"""Laws on sets whose data are computed from t, in batches.

XLA computes such data again where they are used, possibly with other roundings. So y, which was clipped
to a bound, need not be equal to this bound in a later comparison. Which of them differ
depends on the flags of XLA: CI runs these tests with those of users too.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax import sets

from ..selection import mostly_thorough

N = 6
RNG = np.random.default_rng(0)
LEFT, RATE = RNG.uniform(-1.2, -0.1, N), RNG.uniform(0.05, 0.15, N)
Q, C = 3.0 * RNG.normal(size=N), RNG.normal(size=N)
R, G = RNG.normal(size=(2, N)), RNG.normal(size=(7, N))
TURNED = RNG.normal(size=(N, N))
M = 1.5 * np.eye(N) + 0.4 * (TURNED - TURNED.T)


def s(t):
    return 0.1 * jnp.sin(3.0 * t) + 0.05 * t


SETS = {
    "box": lambda t: sets.Box(LEFT + RATE * t, 0.3 + RATE * jnp.sin(1.3 * t)),
    "box with a sum": lambda t: sets.ConstrainedBox(
        LEFT + RATE * t, 1.0 + RATE * t, R[:1], 0.1 + s(t)[None], 0.1 + s(t)[None]
    ),
    "box with two sums": lambda t: sets.ConstrainedBox(
        LEFT + RATE * t, 1.0 + RATE * t, R, s(t) - np.array([0.2, 0.5]), s(t) + np.array([0.1, 0.2])
    ),
    "simplex": lambda t: sets.Simplex(1.0 + s(t)),
    "simplices": lambda t: sets.Simplex(jnp.stack([1.0 + s(t), 0.5 + 2.0 * s(t)]), (4, 2)),
    "L1 ball": lambda t: sets.L1Ball(C * s(t), 0.8 + s(t)),
    "ball": lambda t: sets.Ball(C * s(t), 0.8 + s(t)),
    "half-space": lambda t: sets.HalfSpace(C, s(t)),
    "hyperplane": lambda t: sets.Hyperplane(C, s(t)),
    "affine": lambda t: sets.AffineSubspace(R, jnp.stack([s(t), s(2.0 * t)])),
    "polyhedron": lambda t: sets.Polyhedron(G, 1.0 + s(t) * np.ones(7)),
    "ellipsoid": lambda t: sets.Ellipsoid(C * s(t), np.abs(C) + 1.0 + 0.3 * s(t)),
    "cone": lambda t: sets.Translated(sets.SecondOrderCone(), C * s(t)),
    "translated simplex": lambda t: sets.Translated(sets.Simplex(1.0), C * s(t)),
    "scaled simplex": lambda t: sets.Scaled(sets.Simplex(1.0 + s(t)), 1.5),
}
LAWS = {
    "pointwise": (lambda y, q: y + 0.3 * jnp.tanh(y) ** 3 - q, 1.0, 2.0),
    "diagonal": (lambda y, q: 1.7 * y - q, 1.7, 1.7),
    "coupled": (lambda y, q: M @ y + 0.3 * jnp.tanh(y) ** 3 - q, 1.5, 5.0),
}
CASES = [(K, law) for K in SETS for law in LAWS]
OFTEN = [("box", "pointwise"), ("box with a sum", "diagonal"), ("box with two sums", "diagonal")]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "law"), mostly_thorough(CASES, OFTEN))
def test_responses_and_derivatives_in_a_batch_of_times(name, law):
    F, gamma, L_F = LAWS[law]

    def solved(t):
        q = Q * (1.0 + 0.3 * jnp.sin(2.0 * t)) + t
        return dvax.solve_vi(F, SETS[name](t), jnp.zeros(N), q, gamma=gamma, L_F=L_F, tol=1e-12)

    response = jax.jit(jax.vmap(lambda t: solved(t).y))
    ts, h = jnp.linspace(0.0, 2.0, 160), 1e-6
    found = jax.jit(jax.vmap(solved))(ts)
    _, slopes = jax.jit(lambda t: jax.jvp(response, (t,), (jnp.ones(len(ts)),)))(ts)
    differences = (response(ts + h) - response(ts - h)) / (2.0 * h)
    assert float(jnp.max(found.error_bound)) < 1e-9
    # At a kink a difference is between the slopes of both sides.
    wrong = np.abs(slopes - differences).max(axis=1) > 1e-4
    assert wrong.sum() <= 1, ts[wrong]
