"""Transforms on a line by half as many complex numbers, against SciPy's and as linear maps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft
from hypothesis import given
from hypothesis import strategies as st

from dvax.generators.line import cosines, of_cosines, of_waves, waves

QUARTERS = st.integers(min_value=1, max_value=40)
SEEDS = st.integers(min_value=0, max_value=2**32 - 1)


def numbers(quarters, seed):
    return np.random.default_rng(seed).normal(size=4 * quarters)


@given(QUARTERS, SEEDS)
def test_waves_are_the_fourier_transform_of_real_numbers(quarters, seed):
    x = numbers(quarters, seed)
    F = np.fft.rfft(x)
    np.testing.assert_allclose(waves(jnp.asarray(x)), F, atol=1e-12)
    np.testing.assert_allclose(of_waves(jnp.asarray(F)), x, atol=1e-13)


@given(QUARTERS, SEEDS)
def test_what_no_real_numbers_have_is_left_out_on_the_way_back(quarters, seed):
    F = np.fft.rfft(numbers(quarters, seed)) + 0j
    F[[0, -1]] += [2j, -3j]
    back = np.fft.irfft(F, 4 * quarters)
    np.testing.assert_allclose(of_waves(jnp.asarray(F)), back, atol=1e-13)


@given(QUARTERS, SEEDS)
def test_cosines_and_sines_are_those_of_type_two(quarters, seed):
    x = numbers(quarters, seed)
    for sign, whole in ((1.0, scipy.fft.dct(x, 2)), (-1.0, scipy.fft.dst(x, 2)[::-1])):
        np.testing.assert_allclose(cosines(jnp.asarray(x), sign), whole, atol=1e-12)
        np.testing.assert_allclose(of_cosines(jnp.asarray(whole), sign), x, atol=1e-13)


@pytest.mark.parametrize("n", [4, 12, 256])
def test_derivatives_go_both_ways(n):
    rng = np.random.default_rng(n)
    x, y = jnp.asarray(rng.normal(size=(2, n)))
    for there in (lambda v: cosines(v, -1.0), lambda v: of_cosines(v, 1.0)):
        moved, pull = jax.jvp(there, (x,), (y,))[1], jax.vjp(there, x)[1]
        np.testing.assert_allclose(moved, there(y), atol=1e-12)
        # ⟨Ty, w⟩ = ⟨y, Tᵀw⟩
        w = jnp.asarray(rng.normal(size=n))
        np.testing.assert_allclose(moved @ w, y @ pull(w)[0], rtol=1e-11)


def test_single_precision_stays_single():
    x = jnp.asarray(numbers(8, 0), jnp.float32)
    c = cosines(x, 1.0)
    assert c.dtype == jnp.float32 and of_cosines(c, 1.0).dtype == jnp.float32
    assert waves(x).dtype == jnp.complex64 and of_waves(waves(x)).dtype == jnp.float32
    np.testing.assert_allclose(of_cosines(c, 1.0), x, atol=1e-6)
