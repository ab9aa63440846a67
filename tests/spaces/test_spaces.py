"""Hilbert spaces: every norm, projection and constant refers to their inner product."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import dvax
from dvax import spaces

WEIGHTS = np.array([0.1, 2.0, 0.7])
SUM = spaces.Product(spaces.Euclidean(), spaces.L2(WEIGHTS))
# Squares of smaller numbers are zero, and with them norms.
numbers = st.floats(1e-100, 1e3) | st.floats(-1e3, -1e-100) | st.just(0.0)
vectors = hnp.arrays(float, 3, elements=numbers)
elements = st.tuples(numbers.map(np.asarray), vectors)


def exact(a, b):
    """⟨a, b⟩ of SUM, by hand."""
    return float(a[0] * b[0] + sum(WEIGHTS * a[1] * b[1]))


def lift(a):
    return jnp.asarray(a[0]), jnp.asarray(a[1])


@given(elements, elements)
@settings(max_examples=50)
def test_product_inner_product_is_the_sum_of_weighted_inner_products(a, b):
    found = float(SUM.inner(lift(a), lift(b)))
    size = np.sqrt(exact(a, a) * exact(b, b))
    assert found == pytest.approx(exact(a, b), abs=1e-13 * size + 1e-300)


@given(elements, elements)
@settings(max_examples=50)
def test_norm_satisfies_cauchy_schwarz_and_the_triangle_inequality(a, b):
    a, b = lift(a), lift(b)
    na, nb = float(SUM.norm(a)), float(SUM.norm(b))
    assert abs(float(SUM.inner(a, b))) <= na * nb * (1 + 1e-12) + 1e-300
    both = (a[0] + b[0], a[1] + b[1])
    assert float(SUM.norm(both)) <= (na + nb) * (1 + 1e-12)


def test_l2_norm_is_the_quadrature_of_the_square():
    n = 1000
    s = (np.arange(n) + 0.5) / n
    space = spaces.L2(np.full(n, 1.0 / n))
    assert float(space.norm(jnp.asarray(np.sin(np.pi * s)))) == pytest.approx(np.sqrt(0.5))
    assert float(space.size()) == pytest.approx(1.0)


def test_norm_derivative_is_zero_at_zero_and_the_unit_vector_elsewhere():
    space = spaces.L2(WEIGHTS)
    slope = jax.grad(space.norm)
    assert np.asarray(slope(jnp.zeros(3))).tolist() == [0.0, 0.0, 0.0]
    a = np.array([3.0, -1.0, 2.0])
    unit = WEIGHTS * a / np.sqrt(np.sum(WEIGHTS * a * a))
    np.testing.assert_allclose(np.asarray(slope(jnp.asarray(a))), unit, rtol=1e-14)


def test_space_zeros_have_the_shape_of_its_elements():
    assert spaces.Euclidean().zeros().shape == ()
    assert spaces.Euclidean(3).zeros().shape == (3,)
    assert spaces.Euclidean((2, 5)).zeros().shape == (2, 5)
    scalar, vector = SUM.zeros()
    assert (scalar.shape, vector.shape) == ((), (3,))
    a = (jnp.asarray(2.0), jnp.array([1.0, 2.0, 3.0]))
    by_weights = sum(float(jnp.sum(w * p * p)) for w, p in zip(SUM.weights(), a, strict=True))
    assert float(SUM.inner(a, a)) == pytest.approx(by_weights, rel=1e-15)
    assert float(SUM.size()) == pytest.approx(1.0 + WEIGHTS.sum())


@pytest.mark.parametrize(
    ("space", "element", "words"),
    [
        (spaces.Euclidean(3), jnp.zeros(2), [r"(2,)", r"(3,)"]),
        (spaces.Euclidean(), jnp.zeros(1), [r"(1,)", r"()"]),
        (spaces.L2(WEIGHTS), jnp.zeros((3, 1)), [r"(3, 1)", r"(3,)"]),
        (SUM, jnp.zeros(3), [r"(3,)", r"((), (3,))"]),
        (SUM, (jnp.zeros(3), jnp.zeros(())), [r"((3,), ())", r"((), (3,))"]),
        (spaces.Euclidean(3), (jnp.zeros(3),), [r"((3,),)", r"(3,)"]),
    ],
)
def test_space_check_names_both_shapes(space, element, words):
    with pytest.raises(dvax.InputError) as caught:
        space.check(element, "x0")
    for word in ["x0", *words]:
        assert word in str(caught.value)


def test_space_check_accepts_the_right_shape():
    SUM.check((jnp.zeros(()), jnp.zeros(3)), "x0")


@pytest.mark.parametrize("bad", [[1.0, 0.0], [1.0, -2.0], [1.0, np.nan], [np.inf, 1.0]])
def test_l2_rejects_weights_that_are_not_positive(bad):
    with pytest.raises(dvax.InputError, match="weights"):
        spaces.L2(np.array(bad))


def test_norm_propagates_nan():
    assert np.isnan(float(SUM.norm((jnp.asarray(1.0), jnp.array([0.0, np.nan, 1.0])))))
