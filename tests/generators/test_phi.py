"""φₖ(z) = ∫₀¹ e^{(1−s)z} s^{k−1}/(k−1)! ds: the weights of every exponential integrator."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from tests.oracles import phi

from dvax.generators.phi import flow_factors, phi_matrix, phi_scalar

# On both sides of the switch at |z| = 1, at 0, where the recurrence cancels, and far out.
ARGUMENTS = np.array(
    [0.0, 1e-300, 1e-12, -1e-8, 1e-4, -0.3, 0.5, -0.999999, 0.999999, -1.0, 1.0, 1.000001,
     -2.5, 3.0, -17.0, -60.0, 20.0]
)  # fmt: skip


@jax.jit
def _phis(z):
    return jnp.stack(phi_scalar(z, 4))


def test_phi_functions_agree_with_their_series_to_a_few_rounding_errors():
    found = np.asarray(_phis(jnp.asarray(ARGUMENTS)))
    for k in range(5):
        exact = np.array([phi(k, z) for z in ARGUMENTS])
        np.testing.assert_allclose(found[k], exact, rtol=1e-14, err_msg=f"φ{k}")


@pytest.mark.parametrize("k", [1, 2, 3])
def test_phi_functions_agree_with_their_integral(k):
    for z in (-5.0, -0.7, 0.2, 2.0):
        exact, _ = scipy.integrate.quad(
            lambda s, z=z: math.exp((1 - s) * z) * s ** (k - 1) / math.factorial(k - 1), 0, 1
        )
        found = float(phi_scalar(jnp.asarray(z), k)[k])
        assert found == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("z", [0.0, -0.4, 0.4, -3.0])
def test_phi_derivative_is_finite_and_correct_at_zero(z):
    # φₖ′(z) = (φₖ(z) − k φ_{k+1}(z) − (the part that comes from 1/k!))/…: from the series
    # Σ j z^{j−1}/(j+k)!, which is φₖ′ = φₖ − k φₖ₊₁ for k ≥ 1 and φ₀′ = φ₀.
    slopes = np.asarray(jax.jit(jax.jacfwd(lambda x: jnp.stack(phi_scalar(x, 3))))(jnp.asarray(z)))
    back = np.asarray(jax.jit(jax.jacrev(lambda x: jnp.stack(phi_scalar(x, 3))))(jnp.asarray(z)))
    exact = [phi(0, z)] + [phi(k, z) - k * phi(k + 1, z) for k in (1, 2, 3)]
    np.testing.assert_allclose(slopes, exact, rtol=1e-12)
    np.testing.assert_allclose(back, exact, rtol=1e-12)


def test_phi_of_a_complex_number_has_the_correct_imaginary_part():
    # φ₁(iθ) = (e^{iθ} − 1)/(iθ), on both branches; a lost imaginary part halves every order.
    for theta in (0.3, 4.0):
        found = complex(phi_scalar(jnp.asarray(1j * theta), 1)[1])
        assert found == pytest.approx((np.exp(1j * theta) - 1) / (1j * theta), rel=1e-14)


MATRICES = {
    "skew": np.array([[0.0, 3.0], [-3.0, 0.0]]),
    "non-normal": np.array([[-1.0, 40.0], [0.0, -1.5]]),
    "singular": np.array([[0.0, 1.0], [0.0, 0.0]]),
    "stiff": np.array([[-500.0, 1.0], [2.0, -0.01]]),
}


@jax.jit
def _matrix_phis(z):
    return jnp.stack(phi_matrix(z, 2))


@pytest.mark.parametrize("name", MATRICES)
def test_phi_of_a_matrix_is_the_integral_of_the_matrix_exponential(name):
    Z = MATRICES[name]
    found = np.asarray(_matrix_phis(jnp.asarray(Z)))
    scale = np.abs(scipy.linalg.expm(Z)).max()
    np.testing.assert_allclose(found[0], scipy.linalg.expm(Z), atol=1e-12 * scale)
    nodes, weights = np.polynomial.legendre.leggauss(120)
    s, w = 0.5 * (nodes + 1), 0.5 * weights
    for k in (1, 2):
        exact = sum(
            wi * scipy.linalg.expm((1 - si) * Z) * si ** (k - 1)
            for si, wi in zip(s, w, strict=True)
        )
        np.testing.assert_allclose(found[k], exact, atol=1e-10 * max(scale, 1.0), err_msg=f"φ{k}")


@pytest.mark.parametrize("size", [1e8, 1e20, 1e80, 1e300])
def test_phi_of_a_matrix_of_any_norm_keeps_its_slow_modes(size):
    """A fast mode of rate −size leaves φₖ(Z) = −Z⁻¹/(k − 1)! there, and drives nothing slow."""
    slow = np.array([[-0.3, 1.0], [-1.0, 0.2]])
    Z = np.zeros((3, 3))
    Z[:2, :2], Z[2, 2] = slow, -size
    found = [np.asarray(v) for v in jax.jit(lambda z: phi_matrix(z, 3))(jnp.asarray(Z))]
    expected = [np.asarray(v) for v in phi_matrix(jnp.asarray(slow), 3)]
    for k in range(4):
        np.testing.assert_allclose(found[k][:2, :2], expected[k], rtol=1e-13, atol=1e-14)
        fast = 0.0 if k == 0 else 1.0 / math.factorial(k - 1)
        assert found[k][2, 2] * size == pytest.approx(fast, abs=1e-6 if size < 1e9 else 1e-12)


def test_flow_factors_include_factorials_and_step_size():
    # ∫₀^h e^{(h−s)a} (s/h)^j ds by quadrature, for a = −2, h = 0.3.
    h, a = 0.3, -2.0
    found = flow_factors(jnp.asarray(h), phi_scalar(jnp.asarray(h * a), 3))
    for j in range(3):
        exact, _ = scipy.integrate.quad(
            lambda s, j=j: math.exp((h - s) * a) * (s / h) ** j, 0, h, epsabs=1e-14
        )
        assert float(found[j + 1]) == pytest.approx(exact, rel=1e-12)
