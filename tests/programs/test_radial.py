"""Functions of a vector and its length are enclosed nearly sharply, also rows of a field."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dvax.programs.slope import SlopeEnclosure, interval
from dvax.programs.slope.values import columns

N = 4
WEIGHTS = jnp.asarray([1.0, -2.0, 0.5, 3.0])

VECTORS = {
    "friction": lambda v: -0.3 * v / jnp.sqrt(1e-4 + v @ v),
    "friction, its square written out": lambda v: v / jnp.sqrt(1e-2 + jnp.sum(v**2)) * 2.0,
    "friction with a product of the sum": lambda v: (-2.0 * v) / jnp.sqrt(0.3 + jnp.sum(v * v)),
    "saturation": lambda v: v / (1.0 + jnp.linalg.norm(v)),
    "saturation with a kink": lambda v: v / jnp.maximum(jnp.linalg.norm(v), 1.0),
    "drag": lambda v: -0.7 * jnp.linalg.norm(v) * v,
    "drag, weighted": lambda v: WEIGHTS * v * jnp.linalg.norm(v) / 3.0,
    "a bell": lambda v: jnp.exp(-v @ v) * v,
    "a bell of its own": lambda v: jnp.exp(-(v @ v) / 2.0)[None] * WEIGHTS,
    "a root": lambda v: jnp.sqrt(1.0 + v @ v) * WEIGHTS,
    "a logarithm": lambda v: jnp.log1p(jnp.vdot(v, v)) * jnp.ones(N),
    "tanh of the length": lambda v: v * (jnp.tanh(3.0 * jnp.sqrt(0.1 + v @ v)) / (0.1 + v @ v)),
    "attraction, softened": lambda v: -v / (0.2 + v @ v) ** 1.5,
    "one divided by it": lambda v: 2.0 / (0.5 + jnp.linalg.norm(v)) * v,
    "relative": lambda v: (lambda w: w / jnp.sqrt(0.01 + w @ w))(jnp.sin(v) - v[::-1]),
}


ROWS = {
    "rows": lambda w: w / jnp.sqrt(1e-2 + jnp.sum(w**2, axis=1, keepdims=True)),
    "rows, indexed": lambda w: w / jnp.sqrt(0.1 + jnp.sum(w * w, axis=-1))[:, None],
    "columns": lambda w: -w * jnp.exp(-jnp.sum(jnp.square(w), axis=0))[None, :],
    "different rows": lambda w: w / (jnp.array([[0.1], [2.0]]) + jnp.sum(w**2, 1, keepdims=True)),
    "transposed": lambda w: (w / jnp.sqrt(0.5 + jnp.sum(w**2, axis=1))[:, None]).T,
    "the lengths of other rows": lambda w: w / jnp.sqrt(0.5 + jnp.sum(w**2, axis=1))[::-1, None],
}


def of_rows(fn):
    return lambda v: fn(v.reshape(2, 2)).reshape(-1)


FUNCTIONS = VECTORS | {name: of_rows(fn) for name, fn in ROWS.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_derivatives_lie_within_bounds_that_do_not_grow_with_the_region(name):
    fn, rng = FUNCTIONS[name], np.random.default_rng(len(name))
    both = jax.jit(jax.vmap(lambda v: (fn(v), jax.jacfwd(fn)(v).T)))
    enclosure = SlopeEnclosure(fn, (jnp.zeros(N),), (0,))
    for size in (0.1, 1.0, 10.0, 300.0):
        for centre in (0.0, rng.uniform(-size, size, N)):
            low, high = np.sort(centre + rng.uniform(-size, size, (2, N)), axis=0)
            out, unknown = enclosure(interval(low, high))
            assert unknown == ()
            part = columns(out.parts[0], N)
            points = np.concatenate([
                rng.uniform(low, high, (400, N)),
                np.clip(10.0 ** rng.uniform(-3, 2, (400, 1)) * rng.normal(size=(400, N)), low, high),
            ])  # fmt: skip
            values, exact = (np.asarray(v) for v in both(points))
            slack = 1e-11 * (1.0 + np.abs(values))
            assert np.all((values >= out.low - slack) & (values <= out.high + slack))
            gap = np.abs(exact - part.center) - part.radius
            assert gap.max() <= 1e-11 * (1.0 + np.abs(exact).max())


LARGEST = {  # the largest ‖∂fn‖ on all of ℝⁿ
    "friction": 30.0, "friction, its square written out": 20.0, "saturation": 1.0,
    "saturation with a kink": 1.0, "a bell": 1.0, "attraction, softened": 0.2**-1.5,
}  # fmt: skip


@pytest.mark.parametrize("name", LARGEST)
@pytest.mark.parametrize("size", [1.0, 30.0, 1e4])
def test_the_norm_of_the_derivative_is_enclosed_within_a_small_factor(name, size):
    fn = FUNCTIONS[name]
    out, _ = SlopeEnclosure(fn, (jnp.zeros(N),), (0,))(
        interval(np.full(N, -size), np.full(N, 0.9 * size))
    )
    part = columns(out.parts[0], N)
    largest = np.linalg.norm(np.abs(part.center) + part.radius, 2)
    assert largest <= 2.7 * LARGEST[name]


def test_away_from_0_the_derivative_is_sharp():
    v = np.array([3.0, -1.0, 2.0, 0.7])
    for name in ("friction", "drag", "a root", "saturation", "attraction, softened"):
        fn = FUNCTIONS[name]
        part = columns(SlopeEnclosure(fn, (jnp.zeros(N),), (0,))(interval(v, v)).out.parts[0], N)
        np.testing.assert_allclose(part.center, jax.jacfwd(fn)(v).T, atol=1e-13)
        assert part.radius.max() < 1e-13
