"""The bound that a solution carries is never below its true error: 10⁵ points near and far from known
solutions of nonmonotone operators a(y)G(y), in double and in single precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.vi.families import COUNT, KINDS, REACH, SIZE, WEIGHTS, cases

import dvax
from dvax.vi import certify, natural_residual, residual_bound

SPACE = dvax.spaces.Euclidean(SIZE)


def measured(kind, weight):
    """ȳ, both bounds and the size of what was rounded, from a point y and a step τ."""
    a, make = WEIGHTS[weight][0], KINDS[kind][1]

    def one(data, A, b, gamma, L, y, tau):
        F, K = lambda v: a(jnp, v) * (A @ v + b), make(*data)
        found = certify(F, K, SPACE, y, tau)
        r = SPACE.norm(natural_residual(F, K, SPACE, y, tau))
        Fy = F(y)
        size = SPACE.norm(Fy) + (SPACE.norm(y) + SPACE.norm(y - tau * Fy)) / tau + SPACE.norm(b)
        return found.y, found.bound(gamma), residual_bound(r, tau, gamma, L), size

    return jax.jit(jax.vmap(one))


def check(kind, weight, rounds, dtype, seed):
    rng, run = np.random.default_rng(seed), measured(kind, weight)
    slack = [[], []]
    for _ in range(rounds):
        *problem, y = cases(kind, rng, weight)
        away = rng.normal(size=y.shape) * 10.0 ** rng.uniform(-7, 0, (COUNT, 1))
        start = y + away * np.minimum(1, 2 / np.linalg.norm(away, axis=1, keepdims=True))
        tau = 10.0 ** rng.uniform(-2, 1, COUNT)
        given = jax.tree.map(lambda v: jnp.asarray(v, dtype), (*problem, start, tau))
        ybar, c0, c1, size = (np.asarray(v, float) for v in run(*given))
        gamma, L = problem[3], problem[4]
        errors = np.linalg.norm(ybar - y, axis=1), np.linalg.norm(start - y, axis=1)
        # Rounding of data and F, which a modulus γ makes errors 1/γ times as large; nothing else.
        eps = float(jnp.finfo(dtype).eps)
        rounding = 16 * eps * size / gamma
        apart = 1 + np.linalg.norm(y, axis=1) + size * tau
        rounding1 = 16 * eps * apart * (1 + L / gamma + 1 / (tau * gamma))
        # L holds between points within reach.
        near = np.maximum(np.linalg.norm(ybar, axis=1), np.linalg.norm(start, axis=1)) <= REACH
        assert np.all(errors[0] <= c0 + rounding)
        assert np.all(errors[1] <= c1 + rounding1, where=near)
        assert near.mean() > 0.5
        for bound, error, floor, kept in zip((c0, c1), errors, (rounding, rounding1), slack):
            clear = near & (error > 10 * floor)
            kept.append(bound[clear] / error[clear])
    c0, c1 = map(np.concatenate, slack)
    print(
        f"{kind}, {weight}, {np.dtype(dtype)}: {rounds * COUNT} points; bound / error of C0: median "
        f"{np.median(c0):.1f}, least {c0.min():.3f}; of C1: median {np.median(c1):.1f}, "
        f"least {c1.min():.3f}"
    )
    # Of use, too: a bound that is always far too large would pass all of the above.
    assert c0.min() < 30


OFTEN = {
    ("box", "a bell"),
    ("ball", "a wave"),
    ("half-space", "a slope"),
    ("simplex", "a fraction"),
}


@pytest.mark.parametrize(("kind", "weight"), sorted(OFTEN))
def test_error_bounds_hold_for_nonmonotone_operators(kind, weight):
    check(kind, weight, 4, jnp.float64, seed=1)


def test_error_bounds_hold_in_single_precision_up_to_rounding():
    check("box", "a wave", 4, jnp.float32, seed=2)


@pytest.mark.thorough  # 16 families and 13 × 500 points each: 104 000
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("weight", WEIGHTS)
@pytest.mark.parametrize("kind", KINDS)
def test_error_bounds_hold_at_a_hundred_thousand_points(kind, weight, dtype):
    check(kind, weight, 13, dtype, seed=3)
