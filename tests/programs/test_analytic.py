"""Enclosures of analytic functions of time in the complex plane, against their values there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.programs.analytic import complex_radius

TABLE = [0.0, 1.0, 2.0, 4.0]
VALUES = [0.5, 3.0, 1.0, 2.0]

CASES = {
    "polynomial": lambda t: 1.0 - 2.0 * t + 0.5 * t**3,
    "wave": lambda t: jnp.sin(3.0 * t) * jnp.cos(t + 0.2),
    "decay": lambda t: jnp.exp(-0.7 * t) / (1.0 + t),
    "root": lambda t: jnp.sqrt(2.0 + t) + (2.0 + t) ** 1.5 + jax.lax.rsqrt(3.0 + t),
    "logarithm": lambda t: jnp.log(3.0 + t) - jnp.log1p(0.5 * t),
    "ramps": lambda t: jnp.tanh(0.5 * t) + jax.nn.sigmoid(t - 1.0),
    "hyperbolic": lambda t: jnp.sinh(t) - jnp.cosh(0.5 * t) + jnp.expm1(t),
    "tangent": lambda t: jnp.tan(0.3 * t),
    "matrix": lambda t: jnp.array([[1.0, -2.0], [0.5, 3.0]]) @ jnp.stack([jnp.sin(t), t * t]),
    "sums": lambda t: jnp.cumsum(jnp.stack([t, t * t, jnp.cos(t)])),
}
"""Analytic near [−0.5, 4], so that their code may be evaluated at complex t."""

BRANCHES = {
    "comparison": (lambda t: jnp.where(t < 2.0, jnp.sin(t), 5.0), lambda t: jnp.sin(t)),
    "remainder": (lambda t: (t % 2.0) ** 2, lambda t: t**2),
    "modulus": (lambda t: jnp.abs(t + 1.0) * jnp.sign(t + 3.0), lambda t: t + 1.0),
    "largest": (lambda t: jnp.maximum(t, t - 1.0) + jnp.minimum(t, 7.0), lambda t: 2.0 * t),
    "clip": (lambda t: jnp.clip(t**2, -1.0, 9.0), lambda t: t**2),
    "index": (lambda t: jnp.array(VALUES)[jnp.floor(t).astype(int)] * t, lambda t: 0.5 * t),
    "table": (dvax.signals.Table(TABLE, VALUES), lambda t: 0.5 + 2.5 * t),
    "interpolation": (
        lambda t: jnp.interp(t, jnp.array(TABLE), jnp.array(VALUES)), lambda t: 0.5 + 2.5 * t,
    ),
}  # fmt: skip
"""Code with branches, and what it computes for 0.1 ≤ t ≤ 0.9."""


def radius(fn, low, high, reach):
    return np.asarray(jax.jit(lambda a, b, r: complex_radius(fn, a, b, r))(low, high, reach))


def check(found, continued, low, high, reach):
    """Values anywhere in a disc of this radius are at most twice as far apart."""
    rng = np.random.default_rng(0)
    size = reach * np.sqrt(rng.uniform(size=400))
    size[:100] = reach
    points = 0.5 * (low + high) + size * np.exp(2j * np.pi * rng.uniform(size=400))
    with jax.numpy_dtype_promotion("standard"):
        values = np.stack([np.ravel(continued(jnp.asarray(z))) for z in points])
    for entry, most in zip(values.T, found, strict=True):
        apart = np.abs(entry[:, None] - entry[None, :]).max()
        assert apart <= 2.0 * most and most < 200.0 * apart


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    ("low", "high", "reach"), [(0.1, 0.9, 0.9), (0.4, 0.6, 0.101), (2.0, 2.4, 1.0)]
)
def test_a_disc_encloses_the_continued_function(name, low, high, reach):
    fn = CASES[name]
    check(radius(fn, low, high, reach), fn, low, high, reach)


@pytest.mark.parametrize("name", BRANCHES)
def test_a_branch_that_the_real_times_decide_is_continued(name):
    fn, branch = BRANCHES[name]
    check(radius(fn, 0.1, 0.9, 2.0), branch, 0.1, 0.9, 2.0)


@pytest.mark.parametrize(
    "fn",
    [
        lambda t: jnp.where(t < 0.5, 0.0, 1.0), lambda t: jnp.abs(t - 0.5), jnp.floor,
        lambda t: jnp.maximum(t, 0.3), lambda t: 1.0 / (t - 0.5), lambda t: jnp.sqrt(t - 0.2),
        lambda t: jnp.log(t - 0.5), lambda t: 1.0 / (1.0 + t), lambda t: jnp.clip(t, 0.2, 3.0),
        lambda t: (t + 0.5) % 1.0, lambda t: jnp.tan(t), lambda t: jnp.cbrt(t),
        lambda t: jnp.where(jnp.floor(2.0 * t) == 1.0, t, 0.0),
        lambda t: jnp.sort(jnp.stack([t, 0.5]))[0],
        dvax.signals.Table([0.0, 0.5, 3.0], [0.0, 1.0, 0.0]),
        lambda t: jnp.array(VALUES)[(2.0 * t).astype(int)],
        lambda t: jax.lax.fori_loop(0, 3, lambda k, v: v * t, t),
    ],
)  # fmt: skip
def test_what_is_not_analytic_or_not_known_has_no_radius(fn):
    assert np.isinf(radius(fn, 0.0, 1.0, 1.7)).all()


def test_one_entry_without_a_radius_leaves_the_others_theirs():
    found = radius(lambda t: jnp.stack([t, jnp.abs(t - 0.5)]), 0.0, 1.0, 1.0)
    assert found[0] == pytest.approx(1.0) and np.isinf(found[1])
