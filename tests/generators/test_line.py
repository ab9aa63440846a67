"""One-dimensional transforms with half as many complex numbers, against SciPy's and as linear maps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft

from dvax.generators import line

dct = jax.jit(line.dct, static_argnums=1)
idct = jax.jit(line.idct, static_argnums=1)
rfft, irfft = jax.jit(line.rfft), jax.jit(line.irfft)

SIZES = pytest.mark.parametrize("n", [4, 8, 12, 60, 256])


def numbers(n):
    return np.random.default_rng(n).normal(size=n)


@SIZES
def test_line_transform_is_the_real_fourier_transform(n):
    x = numbers(n)
    F = np.fft.rfft(x)
    np.testing.assert_allclose(rfft(jnp.asarray(x)), F, atol=1e-12)
    np.testing.assert_allclose(irfft(jnp.asarray(F)), x, atol=1e-13)


@SIZES
def test_line_inverse_transform_ignores_imaginary_parts_of_real_modes(n):
    F = np.fft.rfft(numbers(n)) + 0j
    F[[0, -1]] += [2j, -3j]
    back = np.fft.irfft(F, n)
    np.testing.assert_allclose(irfft(jnp.asarray(F)), back, atol=1e-13)


@pytest.mark.slow
@SIZES
def test_line_cosine_and_sine_transforms_are_of_type_two(n):
    x = numbers(n)
    for sign, whole in ((1.0, scipy.fft.dct(x, 2)), (-1.0, scipy.fft.dst(x, 2)[::-1])):
        np.testing.assert_allclose(dct(jnp.asarray(x), sign), whole, atol=1e-12)
        np.testing.assert_allclose(idct(jnp.asarray(whole), sign), x, atol=1e-13)


@pytest.mark.slow
@SIZES
def test_line_transforms_have_derivatives_in_both_modes(n):
    rng = np.random.default_rng(n)
    x, y = jnp.asarray(rng.normal(size=(2, n)))
    for there in (lambda v: dct(v, -1.0), lambda v: idct(v, 1.0)):
        moved, pull = jax.jvp(there, (x,), (y,))[1], jax.vjp(there, x)[1]
        np.testing.assert_allclose(moved, there(y), atol=1e-12)
        # ⟨Ty, w⟩ = ⟨y, Tᵀw⟩
        w = jnp.asarray(rng.normal(size=n))
        np.testing.assert_allclose(moved @ w, y @ pull(w)[0], rtol=1e-11)


def test_line_transforms_keep_single_precision():
    x = jnp.asarray(numbers(32), jnp.float32)
    c = dct(x, 1.0)
    assert c.dtype == jnp.float32 and idct(c, 1.0).dtype == jnp.float32
    assert rfft(x).dtype == jnp.complex64 and irfft(rfft(x)).dtype == jnp.float32
    np.testing.assert_allclose(idct(c, 1.0), x, atol=1e-6)
