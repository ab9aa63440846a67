"""Error bounds include rounding of projections, distant guesses, uncertain comparisons and norms."""

import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax


@pytest.mark.slow
@pytest.mark.parametrize("far", mostly_thorough([1e3, 1e4, 1e6, 1e8], [1e8]))
@pytest.mark.parametrize("kind", ["Ball", "Translated", "HalfSpace"])
def test_error_bound_includes_rounding_of_sets_far_from_zero(kind, far):
    """For F(y) = y − q the solution is the projection of q, in rational arithmetic."""
    rng, wrong = np.random.default_rng(0), []
    for _ in range(12):
        q, a = rng.normal(size=2), rng.normal(size=2)
        o = far * rng.normal(size=2)
        b = -float(a @ o)
        normal, offset = jnp.asarray(a), b
        if kind == "Ball":
            radius = float(np.hypot(*o)) * 0.999999
            K = dvax.sets.Ball(jnp.asarray(o), radius)
            way = [Fraction(v) - Fraction(w) for v, w in zip(q, o, strict=True)]
            length = _root(way[0] ** 2 + way[1] ** 2)
            share = min(Fraction(1), Fraction(radius) / length)
            exact = [Fraction(w) + share * v for w, v in zip(o, way, strict=True)]
        else:
            inner = dvax.sets.HalfSpace(normal, offset)
            K = dvax.sets.Translated(inner, jnp.asarray(o)) if kind == "Translated" else inner
            shift = [Fraction(v) for v in o] if kind == "Translated" else [Fraction(0)] * 2
            fa = [Fraction(v) for v in a]
            z = [Fraction(v) - s for v, s in zip(q, shift, strict=True)]
            over = max(Fraction(0), fa[0] * z[0] + fa[1] * z[1] - Fraction(b))
            over /= fa[0] ** 2 + fa[1] ** 2
            exact = [v - over * n + s for v, n, s in zip(z, fa, shift, strict=True)]
        vi = dvax.solve_vi(lambda y, q: y - q, K, jnp.zeros(2), jnp.asarray(q), gamma=1.0)
        off = [Fraction(float(v)) - w for v, w in zip(vi.y, exact, strict=True)]
        error = float(_root(off[0] ** 2 + off[1] ** 2))
        good = vi.result == dvax.vi.RESULTS.successful
        if error > float(vi.error_bound) or (good and error > 1e-10):
            wrong.append((error, float(vi.error_bound), good))
    assert not wrong


def _root(v):
    """√v to 40 digits."""
    if v == 0:
        return Fraction(0)
    scale = 10**80
    return Fraction(math.isqrt(int(v * scale)), 10**40)


@pytest.mark.parametrize("solver", [dvax.vi.Projection(), dvax.vi.Accelerated()])
@pytest.mark.parametrize("far", mostly_thorough([1e4, 1e6, 1e9, 1e12], [1e9]))
def test_error_bound_includes_rounding_of_a_distant_guess(solver, far):
    rng, N = np.random.default_rng(0), 200
    y0, q = far * rng.uniform(1, 2, (N, 1)), rng.normal(size=(N, 1))
    g = rng.uniform(0.5, 4, N)

    def one(y0, q, g):
        found = dvax.solve_vi(
            lambda y, a: a[0] * y - a[1], dvax.sets.WholeSpace(), y0, (g, q), solver=solver,
            gamma=g, L_F=g, tol=1e-6,
        )  # fmt: skip
        return found.y, found.error_bound

    y, bound = map(np.asarray, jax.jit(jax.vmap(one))(y0, q, g))
    exact = [Fraction(q[k, 0]) / Fraction(g[k]) for k in range(N)]
    off = [abs(Fraction(float(y[k, 0])) - exact[k]) for k in range(N)]
    assert all(e <= Fraction(float(b)) for e, b in zip(off, bound, strict=True))


def test_error_bound_accounts_for_norms_that_underflow():
    w = np.float32(1e-20)
    vi = dvax.solve_vi(
        lambda y, q: w * jnp.array([1, 3], jnp.float32) * y - q,
        dvax.sets.Box(np.float32(-1), np.float32(1)), jnp.zeros(2, jnp.float32),
        jnp.array([w / 2, w]), solver=dvax.vi.Extragradient(), gamma=w, tol=np.float32(1e-4),
    )  # fmt: skip
    error = float(jnp.linalg.norm(vi.y - jnp.array([1 / 2, 1 / 3], jnp.float32)))
    assert error <= float(vi.error_bound)
    assert error < 1e-4 or vi.result != dvax.vi.RESULTS.successful


DOUBTFUL = {
    # F = y − φ(s), s = (c₀ + c₁) − c₀ whose exact value is c₁: φ, and φ(c₁).
    "square": (lambda s: s**2, 5e-5, 2.5e-9),
    "cosine": (lambda s: 1 - jnp.cos(s), 5e-5, 1.25e-9),
    "sign": (lambda s: jnp.sign(s) * jnp.sqrt(jnp.abs(s)), 1e-6, 1e-3),
    "choice": (lambda s: jnp.where(s > 0, 0.5, 0.0), 5e-5, 0.5),
    "floor": (lambda s: 0.1 * jnp.floor(s), -5e-5, -0.1),
}


@pytest.mark.parametrize("name", DOUBTFUL)
def test_error_bound_covers_comparisons_in_F_decided_by_rounding(name):
    phi, c, exact = DOUBTFUL[name]
    vi = dvax.solve_vi(
        lambda y, args: y - phi((args[0] + args[1]) - args[0]), dvax.sets.Box(-1.0, 1.0),
        jnp.zeros(1), (1e12, c), gamma=1.0,
    )  # fmt: skip
    assert abs(float(vi.y[0]) - exact) <= float(vi.error_bound)
