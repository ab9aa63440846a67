"""Slopes of selections: enclosed where the branches agree at the switch, unbounded otherwise."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dvax.programs.slope import SlopeEnclosure, interval

W = jnp.asarray(np.random.default_rng(5).normal(size=3))


def where_above(v, c, yes, no):
    return jnp.where(v > c, yes(v), no(v))


# (function of a vector of three, the largest |∂ᵢfₖ| that may be proved on [−2, 2])
CONTINUOUS = {
    "leaky rectifier": (lambda v: jnp.where(v > 0, v, 0.1 * v), 1.0),
    "written from the other side": (lambda v: jnp.where(0.3 >= v, 0.3 + 2.0 * (v - 0.3), v), 2.0),
    "rounded constants": (lambda v: jnp.where(v > 1.0, 3.0 * (v - 0.9), 0.3 * v), 3.0),
    "affine condition": (lambda v: jnp.where(2.0 * v - 1.0 < 0, 0.5 - v, v - 0.5), 1.0),
    "two entries": (lambda v: jnp.where(v[0] > v[1], v[0] - v[1], 0.0) * W, 1.0 * 2.0),
    "one condition for all": (lambda v: jnp.where(v[2] > 0.5, v + W * (v[2] - 0.5), v), 2.5),
    "a common term": (lambda v: jnp.where(v[0] > 0, v[0] * v[1] + jnp.sin(v[2]), jnp.sin(v[2])), 2.0),
    "an array of limits": (lambda v: jnp.where(v > W, W + 2.0 * (v - W), v), 2.0),
    "elu": (jax.nn.elu, 1.0),
    "selu": (jax.nn.selu, 1.8),
    "leaky_relu": (jax.nn.leaky_relu, 1.0),
    "celu": (lambda v: jax.nn.celu(v, 0.5), 2.0),
    "relu6": (jax.nn.relu6, 1.0),
    "hard_tanh": (jax.nn.hard_tanh, 1.0),
    "quadratic near 0 (Huber)": (
        lambda v: jnp.where(jnp.abs(v) <= 1.0, 0.5 * v**2, jnp.abs(v) - 0.5), 1.0,
    ),
    "dead zone": (lambda v: jnp.where(v > 1, v - 1, jnp.where(v < -1, v + 1, 0.0)), 1.0),
    "three pieces": (lambda v: jnp.where(v < -1, -2.0 - v, jnp.where(v < 1, v, 2.0 - v)), 1.0),
    "a root that is guarded": (
        lambda v: jnp.where(v > 1.0, jnp.sqrt(jnp.where(v > 1.0, v, 1.0)), 0.5 + 0.5 * v), 0.5,
    ),
    "a guard with a jump": (
        lambda v: jnp.where(v > 1.0, jnp.log(jnp.where(v > 1.0, v, 7.0)), 0.0), 1.0,
    ),
    "a square that starts": (lambda v: jnp.where(v < 0, 0.0, v**2), 4.0),
    "a window": (lambda v: jnp.where((v > 0) & (v < 1), v * (1 - v), 0.0), 1.0),
    "outside of a window": (lambda v: jnp.where((v < 0) | (v > 1), 0.0, v * (1 - v)), 1.0),
    "negated": (lambda v: jnp.where(~(v > 0), 0.0, v), 1.0),
    "a jump outside of the branch": (
        lambda v: jnp.where(v > 0, v * jnp.where(v > -1, 1.0, 2.0), 0.0), 1.0,
    ),
    "called": (lambda v: jax.jit(lambda w: jnp.where(w > 0, w, 2.0 * w))(v) + v, 3.0),
    "the first of several conditions": (
        lambda v: jnp.select([v < 0.0, v < 1.0, v < 1.5], [0.0 * v, v, 2.0 * v - 1.0], 2.0), 2.0,
    ),
    "windows one beside the other": (
        lambda v: jnp.select([v < 0, (v >= 0) & (v <= 1), v > 1], [0.0 * v, v, 2.0 * v - 1.0]), 2.0,
    ),
    "a condition and its opposite": (
        lambda v: jnp.select([v[0] < v[1], v[0] >= v[1]], [v[1] * W, v[0] * W], 7.0),
        float(np.abs(W).max()),
    ),
    "conditions of one number each": (
        lambda v: jax.vmap(lambda s: jnp.select([s < -1.0, s < 1.0], [-1.0, s], 1.0))(v), 1.0,
    ),
    "a conditional for each entry": (
        lambda v: jax.vmap(lambda s: jax.lax.cond(s > 0.5, lambda: 2.0 * s - 1.0, lambda: s - 0.5))(v),
        2.0,
    ),
    "a number against an array": (lambda v: jnp.where(v[0] < W, v[0], W), 1.0),
    "function of the condition": (
        lambda v: jnp.where(jnp.sin(v) > 0, jnp.sin(v), 0.5 * jnp.sin(v)), 1.0,
    ),
}  # fmt: skip

DISCONTINUOUS = {
    "step": lambda v: jnp.where(v > 0, 1.0, 0.0),
    "a small jump": lambda v: jnp.where(v > 0, v + 1e-9, v),
    "a jump beside a sentinel": lambda v: jnp.where(v > 0, jnp.minimum(v + 1.0, 1e30), v),
    "a jump beside a large term": lambda v: jnp.where(v > 0, v + 1.0 + 1e30 * v, v * 1e20),
    "a jump beside a small quotient": lambda v: jnp.where(v > 0.5, v / 1e-30 * 1e-30 + 1.0, v),
    "wrong limit": lambda v: jnp.where(v > 0.5, v - 0.4, 0.0),
    "another entry": lambda v: jnp.where(v > 0, v[::-1], 0.0),
    "another entry by an index": lambda v: jnp.where(v > 0, v[jnp.array([1, 2, 0])], 0.0),
    "rows against columns": lambda v: jnp.where(v[:, None] > 0, v[None, :], 0.0),
    "a transposed matrix": lambda v: jnp.where(
        jnp.outer(v, jnp.ones(3)) > 0, jnp.outer(v, jnp.ones(3)).T, 0.0
    ),
    "one edge of a window": lambda v: jnp.where((v > 0) & (v < 1), v, 0.0),
    "another condition": lambda v: jnp.where((v > 0) & (v[0] > 0.3), v, 0.0),
    "inner jump": lambda v: jnp.where(v > 0, jnp.where(v > 1.0, v, 0.5 * v), 0.0),
    "inner jump in the branch": lambda v: jnp.where(v > 0, v * jnp.where(v > 1, 1.0, 2.0), 0.0),
    "one of two limits": lambda v: jnp.where(jnp.abs(v) < 1.0, v, 1.0),
    "limit by parity": lambda v: jnp.where(v > 0, jnp.floor(v), -1.0),
    "a jump of an integer": lambda v: jnp.where(
        v > 0, (v + 0.5).astype(int).astype(float) * v, 0.1 - v
    ),
    "the sum": lambda v: jnp.where(jnp.sum(v) > 0.1, v, 2.0 * v),
    "a gap between windows": lambda v: jnp.select([v < 0, (v >= 0) & (v < 1), v > 1], [0 * v, v, v]),
    "the first of two conditions": lambda v: jnp.select([v < 1.0, v < 0.0], [v, 2.0 * v], 0.0),
    "opposites without the limit": lambda v: jnp.select([v < 0.3, v > 0.3], [v, v], 7.0),
    "equal to": lambda v: jnp.where(v == 0.5, 1.0, v),
}  # fmt: skip


def jacobian(part):
    if part.full:
        return part.center.reshape(3, -1), part.radius.reshape(3, -1)
    return np.diag(part.center), np.diag(part.radius)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTINUOUS)
def test_selection_whose_branches_agree_has_a_bounded_slope(name):
    fn, most = CONTINUOUS[name]
    enclosure = SlopeEnclosure(fn, (jnp.zeros(3),), (0,))
    out, unknown = enclosure(interval(np.full(3, -2.0), np.full(3, 2.0)))
    center, radius = jacobian(out.parts[0])
    assert unknown == () and np.max(np.abs(center) + radius) <= most * (1 + 1e-12)
    rng, both = np.random.default_rng(1), jax.jit(jax.vmap(fn))
    for width in np.repeat([4.0, 1.0, 0.1], 20):
        low = rng.uniform(-2.0, 2.0, 3)
        high = low + width * rng.uniform(0.0, 1.0, 3)
        out = enclosure(interval(low, high)).out
        points = rng.uniform(low, high, (60, 3))
        points[0], points[1] = low, high
        values = np.asarray(both(points)).reshape(len(points), -1)
        slack = 1e-12 * (1.0 + np.abs(values))
        assert np.all(values >= out.low.ravel() - slack) and np.all(
            values <= out.high.ravel() + slack
        )
        center, radius = jacobian(out.parts[0])
        for i, j in itertools.combinations(range(0, 60, 4), 2):
            d = points[i] - points[j]
            gap = np.abs(values[i] - values[j] - d @ center)
            assert np.all(gap <= np.abs(d) @ radius + 1e-11)


@pytest.mark.parametrize("name", DISCONTINUOUS)
def test_selection_that_jumps_has_an_unbounded_slope(name):
    enclosure = SlopeEnclosure(DISCONTINUOUS[name], (jnp.zeros(3),), (0,))
    out, _ = enclosure(interval(np.full(3, -2.0), np.full(3, 2.0)))
    assert np.isinf(out.parts[0].radius).any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_random_pieces_are_continuous_only_if_they_meet(seed):
    """Two random functions meet at a random limit after one of them was moved there."""
    rng = np.random.default_rng(seed)
    c, k = round(rng.uniform(-1, 1), 2), int(rng.integers(1, 4))
    a, b = (np.round(rng.normal(size=4) * 10.0 ** rng.integers(-4, 5), 3) for _ in range(2))
    first = lambda v: a[0] + a[1] * (v - c) + a[2] * (v - c) ** k  # noqa: E731
    second = lambda v: b[1] * (v - c) * jnp.cos(b[3] * v) + b[2] * (v - c) ** 2  # noqa: E731
    compare = [jnp.greater, jnp.less, jnp.greater_equal, jnp.less_equal][seed % 4]
    meeting = lambda v: jnp.where(compare(v, c), first(v), a[0] + second(v))  # noqa: E731
    apart = lambda v: jnp.where(compare(v, c), first(v), b[0] + second(v))  # noqa: E731
    box = interval(np.full(3, -2.0), np.full(3, 2.0))
    slope = lambda fn: SlopeEnclosure(fn, (jnp.zeros(3),), (0,))(box).out.parts[0].radius  # noqa: E731
    assert np.isfinite(slope(meeting)).all()
    assert np.isinf(slope(apart)).any() or a[0] == b[0]


def test_nested_selections_take_bounded_work():
    def fn(v):
        for k in range(60):
            v = jnp.where(v > 0.1 * k, v, 0.5 * v + 0.05 * k)
        return v

    enclosure = SlopeEnclosure(fn, (jnp.zeros(3),), (0,))
    part = enclosure(interval(np.full(3, -2.0), np.full(3, 2.0))).out.parts[0]
    assert np.max(np.abs(part.center) + part.radius) <= 1.0


LIMITS = jnp.asarray([0.0, -1.5, 0.5])

# Functions of (x, s) whose branches take other entries than their own. s selects: they may jump in it.
MIXING = {
    "a sum": lambda x, s: jnp.where(s < 1.0, jnp.sum(jnp.where(s < 1.0, 0.0, 9.0)), 0.0) * x,
    "the entry before": lambda x, s: jnp.where(s < 1, jnp.roll(jnp.where(s < 1, 0.0, 9.0), 1), 0.0) * x,
    "a sum of what is cut off": lambda x, s: jnp.where(s < 1, jnp.sum(jnp.maximum(s - 1, 0)), 0.0) * x,
    "the largest": lambda x, s: jnp.where(s < 1.0, jnp.max(s), 0.0) * x,
    "the condition of another row": lambda x, s: jnp.where(
        (s < 1.0)[:, None], jnp.where((s < 1.0)[None, :], 0.0, 9.0), 0.0
    ) @ x,
    "a dead zone with a common factor": lambda x, s: jnp.where(
        jnp.abs(x) <= 0.1, (0.1 - jnp.abs(x)) * x[0], 0.0
    ),
    "a dead zone with the sum": lambda x, s: jnp.where(
        jnp.abs(x) <= 0.1, (0.1 - jnp.abs(x)) * jnp.sum(x), 0.0
    ),
    "a number against an array": lambda x, s: jnp.where(x[0] >= LIMITS, (x[0] - LIMITS) ** 2, 0.0 * x),
    "the sign of a sum": lambda x, s: jnp.where(jnp.sum(s) > 0.0, jnp.sum(jnp.abs(s)) * x, x[::-1]),
    "several conditions": lambda x, s: jnp.select(
        [s < 0.0, s < 1.0], [jnp.sum(s) * x, jnp.max(s) * x], jnp.min(s) * x
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", MIXING)
def test_a_condition_says_nothing_about_other_entries(name):
    fn = MIXING[name]
    enclosure = SlopeEnclosure(fn, (jnp.zeros(3), jnp.zeros(3)), (0,))
    rng = np.random.default_rng(11)
    derivative = jax.jit(jax.vmap(jax.jacfwd(fn)))
    for width in np.repeat([6.0, 1.5, 0.3], 8):
        low = rng.uniform(-2.0, 2.0, (2, 3))
        high = low + width * rng.uniform(0.0, 1.0, (2, 3))
        out, unknown = enclosure(*map(interval, low, high))
        center, radius = jacobian(out.parts[0])
        points = rng.uniform(low[:, None], high[:, None], (2, 400, 3))
        found = np.moveaxis(np.asarray(derivative(*points)), 1, 2)
        assert unknown == () and np.all(np.abs(found - center) <= radius + 1e-12)
