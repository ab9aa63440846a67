"""`Rotation` (complex spectrum) against its matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import dvax
from dvax import generators, spaces

PLANE = spaces.Product(spaces.Euclidean(3), spaces.Euclidean(3))
A, B = np.array([-0.3, 0.2, 0.0]), np.array([2.0, -1.0, 5.0])
MATRIX = np.block([[np.diag(A), -np.diag(B)], [np.diag(B), np.diag(A)]])


def split(v):
    return jnp.asarray(v[:3]), jnp.asarray(v[3:])


def test_rotation_equals_its_matrix():
    rotation, dense = generators.Rotation(A, B), generators.Dense(MATRIX)
    x0, c0, c1, c2 = np.random.default_rng(0).normal(size=(4, 6))
    found = rotation.propagator(0.7, 3).step(split(x0), tuple(map(split, (c0, c1, c2))))
    exact = dense.propagator(0.7, 3).step(jnp.asarray(x0), tuple(map(jnp.asarray, (c0, c1, c2))))
    np.testing.assert_allclose(np.concatenate(found), np.asarray(exact), rtol=1e-12)
    np.testing.assert_allclose(np.concatenate(rotation.apply(split(x0))), MATRIX @ x0, rtol=1e-14)


@pytest.mark.parametrize("weights", [(1.0, 1.0), (0.3, 2.0)])
def test_rotation_growth_bound_holds(weights):
    space = spaces.Product(*(spaces.L2(np.full(3, w)) for w in weights))
    M, omega = map(float, generators.Rotation(A, B).growth(space))
    root = np.diag(np.sqrt(np.repeat(weights, 3)))
    found = [
        np.linalg.norm(root @ scipy.linalg.expm(t * MATRIX) @ np.linalg.inv(root), 2)
        / np.exp(omega * t)
        for t in np.linspace(0.01, 6.0, 60)
    ]
    assert max(found) <= M * (1 + 1e-12)
    assert omega == 0.2 and (M == 1.0) == (weights[0] == weights[1])


@pytest.mark.slow
def test_rotation_step_stays_within_its_curvature_bound():
    rotation, h = generators.Rotation(A, B), 0.1
    x0, c0, c1 = map(split, np.random.default_rng(1).normal(size=(3, 6)))
    scaled = lambda s: tuple(s * v for v in c1)  # noqa: E731
    step = lambda s: rotation.propagator(s * h, 2).step(x0, (c0, scaled(s)))  # noqa: E731
    thetas = jnp.linspace(0.0, 1.0, 41)
    path = jax.vmap(step)(thetas)
    end = tuple(v[-1] for v in path)
    bounds = rotation.chord_deviation(
        generators.FlowStep(h, x0, end, (c0, c1)), PLANE, rotation.growth(PLANE)
    )
    for along, start, last, bound in zip(path, x0, end, bounds, strict=True):
        line = (1 - thetas[:, None]) * start[None, :] + thetas[:, None] * last[None, :]
        assert np.all(np.abs(np.asarray(along - line)) <= np.asarray(bound)[None, :] + 1e-14)


def test_rotation_wave_conserves_energy_and_is_periodic():
    laplacian = generators.Elliptic(32, np.pi, "dirichlet")
    frequency = jnp.sqrt(-laplacian.symbol)
    wave = generators.Rotation(0.0, -frequency, laplacian.transform)
    q, p = np.random.default_rng(2).normal(size=(2, 32))
    x = jnp.asarray(q), jnp.asarray(p)
    energy = lambda v: float(sum(jnp.sum(part**2) for part in v))  # noqa: E731
    assert energy(wave.semigroup(7.3, x)) == pytest.approx(energy(x), rel=1e-13)
    for part, start in zip(wave.semigroup(2 * np.pi, x), x, strict=True):
        np.testing.assert_allclose(np.asarray(part), np.asarray(start), atol=1e-11)
    # w'' = w_ss from w = sin 3s at rest: q = 3w.
    s = (np.arange(32) + 0.5) * np.pi / 32
    q, p = wave.semigroup(0.4, (jnp.asarray(3 * np.sin(3 * s)), jnp.zeros(32)))
    np.testing.assert_allclose(np.asarray(q), 3 * np.cos(1.2) * np.sin(3 * s), atol=1e-13)
    np.testing.assert_allclose(np.asarray(p), -3 * np.sin(1.2) * np.sin(3 * s), atol=1e-13)


def test_rotation_schroedinger_packet_conserves_norm_with_order_two():
    # i ψ' = −ψ_ss + V ψ with V in f: ‖ψ‖ stays to the order of the method.
    laplacian = generators.Elliptic(64, 2 * np.pi, "periodic")
    s = np.arange(64) * 2 * np.pi / 64
    V = np.cos(s)
    problem = dvax.Problem(
        A=generators.Rotation(0.0, laplacian.symbol, laplacian.transform),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.WholeSpace(),
        f=lambda t, x, u, args: (V * x[1], -V * x[0]),
        h=lambda t, x, u, args: 0.0 * u,
        control_space=spaces.Euclidean(1),
    )
    packet = np.exp(np.cos(s - 1.0) + 2j * s)
    x0 = jnp.asarray(packet.real), jnp.asarray(packet.imag)
    n = 64
    waves = np.exp(2j * np.pi * np.outer(np.fft.fftfreq(n, 1 / n), np.arange(n)) / n) / np.sqrt(n)
    k = np.fft.fftfreq(n, 1 / n)
    H = waves.conj().T @ np.diag(k**2) @ waves
    exact = scipy.linalg.expm(-1j * (H.conj() + np.diag(V))) @ packet
    errors = []
    for steps in (100, 200, 400):
        q, p = dvax.solve(problem, x0, 0.0, 1.0, dt=1 / steps).xs
        errors.append(np.max(np.abs(np.asarray(q[-1]) + 1j * np.asarray(p[-1]) - exact)))
    assert np.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.15)


def test_rotation_rejects_invalid_arguments():
    with pytest.raises(dvax.InputError, match="same shape"):
        generators.Rotation(np.zeros(2), np.zeros(3))
    with pytest.raises(dvax.InputError, match="state space"):
        generators.Rotation(A, B).check(spaces.Euclidean(3))
