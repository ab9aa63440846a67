"""The structure of a function from its code: claims are true, and sufficient for the fast paths.

Each function stands beside the truth, decided by hand: is it affine, is Fᵢ a function of yᵢ alone,
is it ay + c with one number a. `analyse` may say less than the truth, never more; for the laws that
the fast paths are meant for it must say all of it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from dvax.vi import analyse, independent

C = jnp.array([1.0, -2.0, 3.0])
MATRIX = jnp.arange(9.0).reshape(3, 3)
MASK = jnp.array([True, False, True])


@jax.custom_jvp
def double_but_claims_otherwise(y):
    return 2.0 * y


@double_but_claims_otherwise.defjvp
def _(primals, tangents):
    return 2.0 * primals[0], 7.0 * tangents[0]


@jax.custom_vjp
def twice(y):
    return 2.0 * y


twice.defvjp(lambda y: (2.0 * y, None), lambda _, g: (2.0 * g,))

# (function, affine, pointwise, isotropic): the truth.
YES, NO = True, False
TRUTH = {
    # Affine and pointwise: all of it must be recognised.
    "a multiple": (lambda y: 2.0 * y, YES, YES, YES),
    "a multiple and a shift": (lambda y: 3.0 * y - C, YES, YES, YES),
    "a difference": (lambda y: y - (C - 0.5 * y), YES, YES, YES),
    "a quotient by a number": (lambda y: y / 4.0, YES, YES, YES),
    "minus": (lambda y: C - (-y), YES, YES, YES),
    "through jit": (lambda y: jax.jit(lambda z: 2.0 * z + C)(y), YES, YES, YES),
    "remat": (lambda y: jax.checkpoint(lambda z: 2.0 * z)(y), YES, YES, YES),
    "a diagonal": (lambda y: C * y, YES, YES, NO),
    "a quotient by an array": (lambda y: y / C, YES, YES, NO),
    "a fixed choice": (lambda y: jnp.where(MASK, y, 2.0 * y), YES, YES, NO),
    "a mask": (lambda y: y * MASK.astype(float), YES, YES, NO),
    # Affine, but entries meet.
    "a matrix": (lambda y: MATRIX @ y, YES, NO, NO),
    "reversed": (lambda y: y[::-1], YES, NO, NO),
    "rolled": (lambda y: jnp.roll(y, 1), YES, NO, NO),
    "a filter": (
        lambda y: jnp.fft.irfft(lax.complex(C[:2], 0.0 * C[:2]) * jnp.fft.rfft(y), 3), YES, NO, NO,
    ),
    "a complex filter": (
        lambda y: jnp.real(lax.complex(y, 2.0 * y[::-1]) * lax.complex(C, C)), YES, NO, NO,
    ),
    "a modulus": (lambda y: jnp.abs(jnp.fft.fft(y)), NO, NO, NO),
    "cumulative": (lambda y: jnp.cumsum(y), YES, NO, NO),
    "the mean": (lambda y: y - jnp.mean(y), YES, NO, NO),
    "gathered": (lambda y: y[jnp.array([2, 0, 1])], YES, NO, NO),
    "written": (lambda y: C.at[jnp.array([2, 0])].set(y[:2]), YES, NO, NO),
    "added at places": (lambda y: y.at[1].add(3.0 * y[2]), YES, NO, NO),
    "a block written": (lambda y: lax.dynamic_update_slice(y, y[1:], (0,)), YES, NO, NO),
    "differences": (lambda y: y - jnp.concatenate([y[:1], y[:-1]]), YES, NO, NO),
    "one entry for all": (lambda y: jnp.broadcast_to(y[0], 3), YES, NO, NO),
    "a choice between orders": (lambda y: jnp.where(MASK, y, y[::-1]), YES, NO, NO),
    "an outer sum": (lambda y: jnp.sum(y[:, None] + y[None, :], axis=1), YES, NO, NO),
    "convolved": (lambda y: jnp.convolve(y, C, mode="same"), YES, NO, NO),
    "scanned": (lambda y: lax.scan(lambda s, v: (s + v, s), 0.0, y)[1], YES, NO, NO),
    # Pointwise, but bent.
    "a square": (lambda y: y * y, NO, YES, NO),
    "a power": (lambda y: y**3, NO, YES, NO),
    "clipped": (lambda y: jnp.clip(y, -1.0, 1.0), NO, YES, NO),
    "a maximum": (lambda y: jnp.maximum(y, C), NO, YES, NO),
    "absolute": (lambda y: jnp.abs(y), NO, YES, NO),
    "a choice by sign": (lambda y: jnp.where(y > 0, y, 2.0 * y), NO, YES, NO),
    "a choice by itself": (lambda y: jnp.where(y > C, C, 0.0 * C), NO, YES, NO),
    "one over": (lambda y: 1.0 / (2.0 + y), NO, YES, NO),
    "a quotient of itself": (lambda y: y / (1.0 + y * y), NO, YES, NO),
    "nonmonotone weight": (lambda y: (2 + jnp.sin(y)) * (y - C), NO, YES, NO),
    "rounded": (lambda y: jnp.round(y), NO, YES, NO),
    "counted": (lambda y: y.astype(int).astype(float), NO, YES, NO),
    "softplus": (lambda y: jax.nn.softplus(y), NO, YES, NO),
    "relu": (lambda y: jax.nn.relu(y), NO, YES, NO),
    # Linear in value, but not what its derivative says: no closed form may be built on it.
    "a derivative rule of its own": (double_but_claims_otherwise, NO, YES, NO),
    "held from differentiation": (lambda y: 2.0 * y + lax.stop_gradient(y), NO, YES, NO),
    # Neither.
    "sorted": (lambda y: jnp.sort(y), NO, NO, NO),
    "the norm": (lambda y: y * jnp.sum(y * y), NO, NO, NO),
    "a quadratic form": (lambda y: (MATRIX @ y) * y, NO, NO, NO),
    "a product with the mirror": (lambda y: y * y[::-1], NO, NO, NO),
    "a moving index": (lambda y: y * y[jnp.argmax(y)], NO, NO, NO),
    "sliced by itself": (
        lambda y: jnp.broadcast_to(lax.dynamic_slice(y, (jnp.argmax(y),), (1,)), (3,)), NO, NO, NO,
    ),
    "written at a moving place": (lambda y: y.at[jnp.argmax(y)].set(0.0), NO, NO, NO),
    "a block at a moving place": (
        lambda y: lax.dynamic_update_slice(y, C[:1], (jnp.argmax(y),)), NO, NO, NO,
    ),
    "a branch": (lambda y: lax.cond(y[0] > 0, lambda: y, lambda: 2.0 * y), NO, NO, NO),
    "a loop": (lambda y: lax.fori_loop(0, 3, lambda _, z: z * y[0] + y, y), NO, NO, NO),
    "while": (lambda y: lax.while_loop(lambda z: z[0] < 5, lambda z: z + 1.0, y), NO, NO, NO),
    "a dot product": (lambda y: jnp.dot(y, y) * C, NO, NO, NO),
    "cumulative product": (lambda y: jnp.cumprod(y), NO, NO, NO),
}  # fmt: skip
MUST_SAY_ALL = [
    name for name in TRUTH
    if name not in (
        # True, but through a primitive that is left as unknown: less is said, nothing wrong.
        "convolved", "scanned",
    )
]  # fmt: skip


@pytest.mark.parametrize("name", TRUTH)
def test_structure_claims_are_true(name):
    F, *truth = TRUTH[name]
    claimed = analyse(F, jnp.ones(3))
    for claim, fact, word in zip(claimed, truth, claimed._fields, strict=True):
        assert fact or not claim, f"{name} is not {word}"


@pytest.mark.slow
@pytest.mark.parametrize("name", TRUTH)
def test_structure_table_of_expected_properties_agrees_with_samples(name):
    # The table above is checked too: differences at random points show what is affine or pointwise.
    F, affine, pointwise, isotropic = TRUTH[name]
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-3, 3, (2, 3))
    at = lambda y: np.asarray(F(jnp.asarray(y)), float)  # noqa: E731
    curvature = np.max(np.abs(at(a) + at(b) - 2 * at((a + b) / 2)))
    if affine:
        assert curvature < 1e-12
    changed = a.copy()
    changed[0] += 1.0
    if pointwise:
        assert np.array_equal(at(changed)[1:], at(a)[1:])
    if isotropic:
        slopes = (at(b) - at(a)) / (b - a)
        np.testing.assert_allclose(slopes, slopes[0])


@pytest.mark.parametrize("name", MUST_SAY_ALL)
def test_structure_recognises_laws_with_a_fast_path(name):
    F, *truth = TRUTH[name]
    assert list(analyse(F, jnp.ones(3))) == truth


def test_structure_of_a_reshape_with_permuted_axes_is_not_pointwise():
    transposed = lambda y: lax.reshape(y, (3, 3), dimensions=(1, 0))  # noqa: E731
    assert not analyse(transposed, MATRIX).pointwise
    assert analyse(lambda y: y.reshape(9).reshape(3, 3) * 1.0, MATRIX).affine


PAIR = (jnp.ones(2), jnp.ones(2))


@pytest.mark.parametrize(
    ("F", "expected"),
    [
        (lambda y: (2.0 * y[0], y[1] - 1.0), (True, True, True)),
        (lambda y: (y[1], y[0]), (True, False, False)),
        (lambda y: (y[0] + y[1], y[1]), (True, False, False)),
        (lambda y: (y[0] * y[1], y[1]), (False, False, False)),
        (lambda y: (y[0] ** 2, y[1]), (False, True, False)),
    ],
    ids=["parts alone", "swapped", "coupled", "multiplied", "one bent"],
)
def test_structure_distinguishes_parts_of_a_tuple(F, expected):
    assert tuple(analyse(F, PAIR)) == expected


def test_structure_of_a_constant_law_is_not_isotropic():
    constant = analyse(lambda y: C, jnp.ones(3))
    assert constant.affine and constant.pointwise and not constant.isotropic


def test_structure_ignores_debug_callbacks():
    def F(y):
        jax.debug.callback(lambda y: None, y)
        return 2.0 * y - 1.0

    assert analyse(F, jnp.ones(3)) == analyse(lambda y: 2.0 * y - 1.0, jnp.ones(3))


def test_independent_detects_dependence_on_t_and_x():
    x, t = jnp.ones(3), jnp.ones(())
    assert independent(lambda t, x: jnp.full(3, 2.0), t, x)
    assert independent(lambda t, x: C * 2.0, t, x)
    assert not independent(lambda t, x: C * t, t, x)
    assert not independent(lambda t, x: (C, jnp.sum(x)), t, x)
    assert not independent(lambda t, x: lax.cond(t > 0, lambda: C, lambda: -C), t, x)
    assert not independent(lambda t, x: jnp.where(x > 0, 1.0, 2.0), t, x)
