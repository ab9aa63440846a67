"""`Elliptic` against matrices by NumPy and their exponentials by SciPy."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft
import scipy.linalg
from tests.selection import mostly_thorough

import dvax
from dvax import generators, spaces
from dvax.generators.transforms import BOUNDARIES, Transform

SHAPES = [(1,), (2,), (5,), (8,), (4, 6), (5, 7), (3, 4, 5)]
KINDS = [(s, b) for s in SHAPES for b in itertools.product(BOUNDARIES, repeat=len(s))]
USUAL = [(s, b) for s, b in KINDS if s in ((1,), (5,))] + [
    ((5, 7), ("neumann", "dirichlet")), ((3, 4, 5), ("dirichlet", "periodic", "neumann")),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "boundary"), mostly_thorough(KINDS, USUAL))
def test_elliptic_transform_agrees_with_its_definition_and_inverts(shape, boundary):
    x = np.random.default_rng(0).normal(size=shape)
    transform = Transform(shape, boundary)
    c = transform.forward(jnp.asarray(x))
    np.testing.assert_allclose(np.asarray(transform.backward(c)), x, atol=1e-13)
    exact = x.astype(complex)
    for axis, (n, kind) in enumerate(zip(shape, boundary, strict=True)):
        k, j = transform.modes(axis)[:, None], np.arange(n)[None, :]
        waves = {
            "periodic": np.exp(-2j * np.pi * k * j / n),
            "neumann": 2 * np.cos(np.pi * k * (j + 0.5) / n),
            "dirichlet": 2 * np.sin(np.pi * k * (j + 0.5) / n),
        }[kind]
        exact = np.moveaxis(np.tensordot(waves, exact, (1, axis)), 0, axis)
    np.testing.assert_allclose(np.asarray(c), exact, atol=1e-12)
    # What one coefficient can be anywhere.
    amplitude = np.broadcast_to(np.asarray(transform.amplitudes()), c.shape)
    for index in np.ndindex(c.shape):
        one = jnp.zeros_like(c).at[index].set(1.0)
        assert np.max(np.abs(np.asarray(transform.backward(one)))) <= amplitude[index] * (1 + 1e-12)


@pytest.mark.parametrize("n", mostly_thorough([16, 17], [17]))
def test_elliptic_cosine_and_sine_transforms_agree_with_scipy(n):
    x = np.random.default_rng(1).normal(size=(n, n))
    found = Transform((n, n), ("neumann", "dirichlet")).forward(jnp.asarray(x))
    exact = scipy.fft.dst(scipy.fft.dct(x, axis=0), axis=1)[:, ::-1]
    np.testing.assert_allclose(np.asarray(found), exact, atol=1e-12)


def along(n, h, kind, d, c):
    """Three-point second difference and central first difference, with what lies beyond the faces."""
    ghost = {"periodic": 0.0, "dirichlet": -1.0, "neumann": 1.0}[kind]
    second, first = -2.0 * np.eye(n), np.zeros((n, n))
    for j in range(n):
        for side in (-1, 1):
            inside = 0 <= j + side < n
            near = (j + side) % n if inside or kind == "periodic" else j
            weight = 1.0 if inside or kind == "periodic" else ghost
            second[j, near] += weight
            first[j, near] += side * weight
    return d * second / h**2 - c * first / (2 * h)


def matrix_of(shape, lengths, boundary, diffusion, velocity, reaction):
    total = reaction * np.eye(int(np.prod(shape)))
    for axis, n in enumerate(shape):
        eyes = [np.eye(m) for m in shape]
        eyes[axis] = along(n, lengths[axis] / n, boundary[axis], diffusion[axis], velocity[axis])
        total += functools.reduce(np.kron, eyes)
    return total


GRIDS = [
    ((6,), ("dirichlet",)), ((5,), ("neumann",)), ((6,), ("periodic",)),
    ((4, 5), ("neumann", "dirichlet")), ((4, 5), ("periodic", "neumann")),
    ((3, 4), ("periodic", "periodic")), ((3, 2, 4), ("periodic", "dirichlet", "neumann")),
]  # fmt: skip


def operator(shape, boundary):
    count = len(shape)
    lengths, diffusion = np.array([1.3, 0.8, 2.0])[:count], np.array([0.1, 0.03, 0.2])[:count]
    moving = np.array([kind == "periodic" for kind in boundary])
    velocity = np.array([0.4, -0.7, 0.2])[:count] * moving
    numbers = (lengths, diffusion, velocity, -0.3)
    A = generators.Elliptic(
        shape, lengths, boundary, diffusion, velocity, reaction=-0.3, scheme="differences"
    )
    return A, matrix_of(shape, lengths, boundary, diffusion, velocity, -0.3), numbers


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "boundary"), mostly_thorough(GRIDS, GRIDS[2::4]))
def test_elliptic_differences_equal_their_matrix(shape, boundary):
    A, matrix, _ = operator(shape, boundary)
    rng, size = np.random.default_rng(2), int(np.prod(shape))
    x0, c0, c1 = rng.normal(size=(3, size))
    box = lambda v: jnp.asarray(v.reshape(shape))  # noqa: E731
    close = functools.partial(np.testing.assert_allclose, rtol=1e-10, atol=1e-11)

    @jax.jit
    def products(x0, c0, c1):
        turned = A.adjoint(spaces.Euclidean(shape))
        flow = A.propagator(0.7, 2).step(x0, (c0, c1))
        plain = A.apply(x0), A.semigroup(0.7, x0)
        return *plain, turned.apply(x0), turned.semigroup(0.7, x0), flow

    *found, flow = products(box(x0), box(c0), box(c1))
    expected = [M @ x0 for B in (matrix, matrix.T) for M in (B, scipy.linalg.expm(0.7 * B))]
    for one, other in zip(found, expected, strict=True):
        close(np.asarray(one).ravel(), other)
    dense = generators.Dense(matrix).propagator(0.7, 2)
    exact = dense.step(jnp.asarray(x0), (jnp.asarray(c0), jnp.asarray(c1)))
    close(np.asarray(flow).ravel(), np.asarray(exact))


@pytest.mark.parametrize(("shape", "boundary"), mostly_thorough(GRIDS, GRIDS[1::2]))
def test_elliptic_growth_bound_holds_and_is_sharp(shape, boundary):
    A, matrix, _ = operator(shape, boundary)
    M, omega = map(float, A.growth(spaces.Euclidean(shape)))
    assert M == 1.0
    for t in (0.01, 0.3, 2.0):
        norm = np.linalg.norm(scipy.linalg.expm(t * matrix), 2)
        assert norm == pytest.approx(np.exp(omega * t), rel=1e-10)
    w = np.random.default_rng(3).uniform(0.2, 3.0, shape)
    M, omega = map(float, A.growth(spaces.L2(w)))
    root = np.sqrt(w.ravel())
    for t in (0.01, 0.3, 2.0):
        moved = root[:, None] * scipy.linalg.expm(t * matrix) / root[None, :]
        assert np.linalg.norm(moved, 2) <= M * np.exp(omega * t) * (1 + 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "boundary"), mostly_thorough(GRIDS, GRIDS[4:5]))
def test_elliptic_step_stays_within_its_curvature_bound(shape, boundary):
    A, _, _ = operator(shape, boundary)
    x0, c0, c1 = jnp.asarray(np.random.default_rng(4).normal(size=(3, *shape)))
    space, h = spaces.Euclidean(shape), 0.2
    step = lambda theta: A.propagator(theta * h, 2).step(x0, (c0, theta * c1))  # noqa: E731
    thetas = jnp.linspace(0.0, 1.0, 41)
    path = np.asarray(jax.vmap(step)(thetas))
    line = np.asarray(jax.vmap(lambda s: (1 - s) * x0 + s * path[-1])(thetas))
    bound = A.chord_deviation(
        dvax.generators.FlowStep(h, x0, jnp.asarray(path[-1]), (c0, c1)), space, A.growth(space)
    )
    assert np.all(np.abs(path - line) <= np.asarray(bound) + 1e-13)
    assert np.max(np.abs(path - line)) >= 0.02 * float(np.max(np.asarray(bound)))


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_elliptic_spectral_scheme_is_exact_for_resolved_modes(boundary):
    n, length, k = 24, 3.0, 4
    s = (np.arange(n) + 0.5) * length / n
    wave = {"periodic": 2 * np.pi, "dirichlet": np.pi, "neumann": np.pi}[boundary] * k / length
    shape = np.sin if boundary == "dirichlet" else np.cos
    v = 0.05 if boundary == "periodic" else 0.0
    A = generators.Elliptic(n, length, boundary, diffusion=0.02, velocity=v, reaction=0.1)
    found = A.semigroup(1.7, jnp.asarray(shape(wave * s)))
    exact = np.exp((0.1 - 0.02 * wave**2) * 1.7) * shape(wave * (s - v * 1.7))
    np.testing.assert_allclose(np.asarray(found), exact, atol=1e-13)


def test_elliptic_pure_advection_conserves_the_norm():
    A = generators.Elliptic((8, 9), 1.0, "periodic", diffusion=0.0, velocity=(0.3, -0.2))
    x = jnp.asarray(np.random.default_rng(5).normal(size=(8, 9)))
    far = A.semigroup(100.0, x)
    # The wave of two cells is the one that an odd derivative does not see.
    assert float(jnp.linalg.norm(far)) == pytest.approx(float(jnp.linalg.norm(x)), rel=1e-13)
    assert float(A.growth(spaces.Euclidean((8, 9))).omega) == 0.0


@pytest.mark.slow
def test_elliptic_keeps_single_precision_and_differentiates_parameters():
    one = np.float32
    # A Python number beside single precision, in any of the parameters, keeps it.
    for given in (
        {"lengths": one(2.0)},
        {"diffusion": one(2.0)},
        {"lengths": np.full(1, one(2.0))},
    ):
        for scheme in ("spectral", "differences"):
            single = generators.Elliptic(8, **given, scheme=scheme)
            assert single.symbol.dtype == np.float32
            assert single.apply(jnp.ones(8, one)).dtype == np.float32
    A = generators.Elliptic(8, one(1.0), "periodic", one(0.1), one(0.2), one(0.0))
    assert A.semigroup(one(0.1), jnp.ones(8, one)).dtype == np.float32

    def end(d):
        s = (np.arange(16) + 0.5) * np.pi / 16
        return generators.Elliptic(16, jnp.pi, diffusion=d).semigroup(
            0.5, jnp.asarray(np.sin(2 * s))
        )[3]

    assert float(jax.grad(end)(0.3)) == pytest.approx(-2.0 * float(end(0.3)), rel=1e-12)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (dict(shape=(2, 2, 2, 2)), "one to three axes"),
        (dict(shape=4, boundary="robin"), "periodic, dirichlet, neumann"),
        (dict(shape=4, lengths=-1.0), "positive and finite"),
        (dict(shape=4, diffusion=-1.0), "generates no semigroup"),
        (dict(shape=(4, 4), diffusion=(1.0, 1.0, 1.0)), "each of the 2 axes"),
        (dict(shape=4, velocity=1.0), "must be periodic"),
        (dict(shape=4, scheme="chebyshev"), "'spectral' or 'differences'"),
    ],
)
def test_elliptic_rejects_invalid_arguments(arguments, words):
    with pytest.raises(dvax.InputError, match=words):
        generators.Elliptic(**arguments)


def test_elliptic_static_coefficients_stay_static_beside_traced_ones():
    """No advection is no advection also where the diffusion is a parameter under jit."""
    x = jnp.arange(1.0, 5.0)
    made = lambda d: dvax.generators.Elliptic(4, 1.0, "neumann", diffusion=d)  # noqa: E731
    found = jax.jit(lambda d: made(d).apply(x))(0.3)
    np.testing.assert_allclose(np.asarray(found), np.asarray(made(0.3).apply(x)), rtol=1e-12)
    assert not jnp.iscomplexobj(jax.jit(lambda d: made(d).symbol)(0.3))
