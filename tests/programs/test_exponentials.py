"""Sums of exponentials are enclosed nearly sharply: logit shares, log-sum-exp and their variants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dvax.programs.slope import SlopeEnclosure, interval
from dvax.programs.slope.values import columns

N = 4
COSTS = jnp.asarray(np.random.default_rng(3).normal(size=(N, N)))
DEMAND = jnp.asarray([3.0, -2.0, 0.5, 1.0])


def by_hand(v):
    return jnp.exp(v) / jnp.sum(jnp.exp(v))


def two_routes(v):
    a, b = jnp.exp(-2.0 * v[0]), jnp.exp(-(v[1] + v[2] - 1.0))
    return jnp.stack([a / (a + b), b / (a + b), a / (b + a), 5.0 * b / (a + b)])


def pairs(v):
    """Return the shares within each of two groups."""
    groups = v.reshape(2, 2)
    weights = jnp.exp(groups - groups.max(axis=1, keepdims=True))
    return (weights / weights.sum(axis=1, keepdims=True)).reshape(-1)


FUNCTIONS = {
    "softmax": jax.nn.softmax,
    "softmax by hand": by_hand,
    "shifted by hand": lambda v: (lambda e: e / e.sum())(jnp.exp(v - v.max())),
    "shifted by another number": lambda v: (lambda e: e / e.sum())(jnp.exp(v - jnp.sin(v[0]))),
    "logit of costs": lambda v: DEMAND * jax.nn.softmax(-0.5 * (v - v.min()) / 2.0 + COSTS[0]),
    "softmax of the columns of a matrix": lambda v: jax.nn.softmax(COSTS + v[:, None], axis=0)[
        :, 1
    ],
    "softmax of products": lambda v: jax.nn.softmax(COSTS * v[None], axis=1) @ DEMAND,
    "one share": lambda v: by_hand(v)[2] * jnp.ones(N),
    "one exponential": lambda v: jnp.exp(v[1]) / jnp.sum(jnp.exp(v)) * jnp.ones(N),
    "a choice to stay": lambda v: jnp.exp(v) / (0.7 + jnp.sum(jnp.exp(v))),
    "weights": lambda v: (lambda e: -DEMAND * e / jnp.sum(e * DEMAND**2))(jnp.exp(v)),
    "two routes": two_routes,
    "groups": pairs,
    "a term twice": lambda v: jnp.exp(v) / (jnp.exp(v) + jnp.exp(v) + jnp.exp(v[::-1])),
    "log of a sum": lambda v: jax.nn.logsumexp(v) * jnp.ones(N) + v,
    "log of a sum by hand": lambda v: (v.max() + jnp.log(jnp.exp(v - v.max()).sum())) * DEMAND,
    "log of a sum without a shift": lambda v: jnp.log(jnp.exp(v).sum()) * DEMAND,
    "log of one and a sum": lambda v: jnp.log1p(jnp.exp(v).sum()) * DEMAND,
    "logarithms of shares": jax.nn.log_softmax,
    "difference from the mean": lambda v: jax.nn.logsumexp(v) - v,
    "exponentials of another function": lambda v: jax.nn.softmax(jnp.sin(v) * v[::-1]),
}


def slopes(fn, low, high):
    enclosure = SlopeEnclosure(fn, (jnp.zeros(N),), (0,))
    out, unknown = enclosure(interval(low, high))
    assert unknown == ()
    return out, columns(out.parts[0], N)


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_derivatives_lie_within_bounds_that_grow_with_no_exponent(name):
    fn, rng = FUNCTIONS[name], np.random.default_rng(len(name))
    both = jax.jit(jax.vmap(lambda v: (fn(v), jax.jacfwd(fn)(v).T)))
    for size in (0.1, 1.0, 5.0, 30.0, 200.0):
        low, high = np.sort(rng.uniform(-size, size, (2, N)), axis=0)
        out, part = slopes(fn, low, high)
        points = np.concatenate([
            rng.uniform(low, high, (300, N)), rng.choice([0.0, 1.0], (50, N)) * (high - low) + low,
        ])  # fmt: skip
        values, exact = (np.asarray(v) for v in both(points))
        finite = np.isfinite(values) & np.isfinite(exact).all(axis=(1, 2))[:, None]
        slack = 1e-11 * (1.0 + np.abs(values))
        assert np.all((values >= out.low - slack) & (values <= out.high + slack) | ~finite)
        gap = np.abs(exact - part.center) - part.radius
        assert np.max(gap[finite[:, 0]]) <= 1e-9 * (1.0 + np.abs(part.center).max())
        # Of a share it is c aₖ p (1 − p) ≤ c aₖ/4, of a logarithm c aₖ p, with numbers below 10.
        if name != "exponentials of another function":
            assert np.max(np.abs(part.center) + part.radius) < 20.0


@pytest.mark.parametrize("size", [1.0, 10.0, 300.0])
def test_shares_and_logarithms_have_the_derivatives_of_the_theory(size):
    low, high = np.full(N, -size), np.full(N, size)
    _, share = slopes(jax.nn.softmax, low, high)
    reach = np.abs(share.center) + share.radius
    assert reach.max() == pytest.approx(0.25, rel=1e-12 if size > 1.0 else 0.3)
    _, log = slopes(lambda v: jax.nn.logsumexp(v)[None] * jnp.ones(1), low, high)
    assert np.max(log.center + log.radius) <= 1.0 and np.min(log.center - log.radius) >= 0.0


def test_at_one_point_the_derivative_is_exact():
    v = np.array([0.3, -1.0, 2.0, 0.7])
    for name in ("softmax", "a choice to stay", "logarithms of shares", "groups", "a term twice"):
        _, part = slopes(FUNCTIONS[name], v, v)
        exact = jax.jacfwd(FUNCTIONS[name])(v).T
        np.testing.assert_allclose(part.center, exact, atol=1e-14)
        assert part.radius.max() < 1e-14


def test_a_quotient_without_exponentials_of_one_sum_has_the_bounds_of_its_operations():
    fn = lambda v: jnp.exp(v) / (jnp.sum(jnp.exp(v)) - 0.5 * jnp.exp(v[0]))  # noqa: E731
    low, high = np.zeros(N), np.full(N, 0.1)
    out, part = slopes(fn, low, high)
    exact = np.asarray(jax.jacfwd(fn)(low).T)
    assert np.all(np.abs(exact - part.center) <= part.radius) and np.isfinite(out.high).all()


# (function of one number, its derivative), where 1 − p is far below the rounding of 1
TAILS = {
    "softplus by hand": (lambda v: jnp.log1p(jnp.exp(v)), jax.nn.sigmoid),
    "logaddexp of a constant": (lambda v: jnp.logaddexp(0.0, v), jax.nn.sigmoid),
    "logaddexp with a constant": (lambda v: jnp.logaddexp(v, 0.0), jax.nn.sigmoid),
    "share": (
        lambda v: jnp.exp(-v) / (1.0 + jnp.exp(-v)),
        lambda v: -jax.nn.sigmoid(v) * jax.nn.sigmoid(-v),
    ),
    "share beside two": (
        lambda v: jax.nn.softmax(jnp.stack([jnp.zeros(3), v, v - 1.0]), axis=0)[0],
        lambda v: -(p := jnp.exp(v) * (1 + jnp.exp(-1.0))) / (1 + p) ** 2,
    ),
}


@pytest.mark.parametrize("name", TAILS)
@pytest.mark.parametrize(("low", "high"), [(-60.0, -40.0), (-32.0, -31.0), (-700.0, -300.0)])
def test_derivatives_in_the_tails_are_bounded_to_their_last_digits(name, low, high):
    fn, derivative = TAILS[name]
    box = interval(np.full(3, low), np.full(3, high))
    part = columns(SlopeEnclosure(fn, (jnp.zeros(3),), (0,))(box).out.parts[0], 3)
    for at in np.linspace(low, high, 7):
        exact = float(derivative(at))
        assert np.all(
            np.abs(exact - np.diagonal(part.center)) <= np.diagonal(part.radius) * (1 + 1e-12)
        )


def test_averages_of_averages_stay_small_programs():
    def fn(v):
        total = jnp.exp(v)
        for _ in range(12):
            total = 0.5 * (total + total[::-1])
        return jnp.log(total)

    part = SlopeEnclosure(fn, (jnp.zeros(N),), (0,))(interval(-np.ones(N), np.ones(N))).out.parts[0]
    assert np.isfinite(part.radius).all()
