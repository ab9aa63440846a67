"""A declared modulus is refuted by two points that contradict it, and a true one never is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.sets import Ball, Box
from dvax.vi import RESULTS, FrozenVI, Weighted, refute_gamma
from dvax.vi.refute import _least_moduli

END = 3 * np.pi / 2
DRIVE = 5.577190427585528
THREE = np.array([1.8911306156075787, 3.617780504042352, END])


def trap(y, _):
    """Not pseudomonotone: the drive is outside the bracket that the weight multiplies."""
    return (2 + jnp.sin(y)) * y - DRIVE


@pytest.mark.slow
def test_refute_gamma_by_three_solutions_of_the_additive_drive():
    """The three solutions have no error bound, and refute every modulus."""
    found = [
        dvax.solve_vi(trap, Box(0.0, END), jnp.array(y0), solver=dvax.vi.SemismoothNewton())
        for y0 in THREE + np.array([0.05, -0.02, -0.05])
    ]
    for vi, solution in zip(found, THREE, strict=True):
        assert vi.result == RESULTS.successful
        assert float(vi.y) == pytest.approx(solution, abs=1e-10)
        assert vi.error_bound is None  # no modulus, so no bound, and no word of uniqueness
    for gamma in (1e-9, 0.1, 1.0):
        broken = refute_gamma(trap, Box(0.0, END), gamma, jnp.stack([vi.y for vi in found]))
        assert broken is not None and broken.gamma < 1e-9
        assert float(broken.y) != float(broken.z)


@pytest.mark.slow
@pytest.mark.parametrize("pair", [(0, 1), (0, 2), (1, 2)])
def test_refute_gamma_by_any_two_solutions(pair):
    broken = refute_gamma(trap, Box(0.0, END), 1e-9, jnp.asarray(THREE[list(pair)]))
    assert broken is not None and broken.gamma < 1e-9


@pytest.mark.slow
def test_refute_gamma_by_points_that_violate_the_definition():
    broken = refute_gamma(trap, Box(0.0, END), 1e-6, jnp.linspace(0.0, END, 40))
    assert broken is not None
    y, z = float(broken.y), float(broken.z)
    assert float(trap(y, None)) * (z - y) > 0
    assert float(trap(z, None)) * (z - y) == pytest.approx(broken.gamma * (z - y) ** 2, rel=1e-9)


@pytest.mark.slow
def test_refute_gamma_refutes_too_large_moduli_and_not_the_true_one():
    # ⟨F(y), y − z⟩ = 0.5‖y − z‖² + a rotation: 0.5 exactly.
    F = lambda y, _: 0.5 * y + 4.0 * jnp.stack([-y[1], y[0]]) - 1.0  # noqa: E731
    points = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (200, 2)))
    assert refute_gamma(F, Ball(0.0, 1.0), 0.5, points) is None
    broken = refute_gamma(F, Ball(0.0, 1.0), 0.6, points)
    assert broken is not None and 0.5 <= broken.gamma < 0.6


@pytest.mark.slow
def test_refute_gamma_accepts_tuples_and_weighted_operators():
    K = dvax.sets.Product(Box(0.0, 1.0), Box(0.0, 1.0))
    F = lambda y, _: (-y[0], y[1])  # noqa: E731
    points = (jnp.array([0.0, 1.0]), jnp.array([0.0, 0.0]))  # both solve it
    assert refute_gamma(F, K, 0.1, points) is not None
    law = Weighted(lambda y, c: 2 + jnp.sin(y), lambda y, c: y - c, M=1.0, mu=1.0)
    points = jnp.linspace(0.0, END, 100)
    assert refute_gamma(law, Box(0.0, END), law.gamma, points, args=2.5) is None


@pytest.mark.parametrize(
    ("points", "gamma", "word"),
    [(jnp.ones((1, 2)), 1.0, "two points"), (jnp.ones(()), 1.0, "two points"),
     (jnp.ones((3, 2)), 0.0, "positive")],
)  # fmt: skip
def test_refute_gamma_rejects_invalid_arguments(points, gamma, word):
    with pytest.raises(dvax.InputError, match=word):
        refute_gamma(lambda y, _: y, Box(0.0, 1.0), gamma, points)


def _random_case(key):
    """Operators with a modulus that is known exactly, or attained, and points that crowd round the
    solution, lie on it twice, or are spread over many sizes."""
    n, count = 3, 6
    k = jax.random.split(key, 9)
    gamma = 10.0 ** jax.random.uniform(k[0], minval=-6.0, maxval=2.0)
    skew = jax.random.normal(k[1], (n, n)) * 10.0 ** jax.random.uniform(
        k[2], minval=-3.0, maxval=2.0
    )
    floor = jax.random.uniform(k[3], minval=0.05, maxval=1.0)
    weighted = jax.random.bernoulli(k[4])
    middle = jax.random.normal(k[5], (n,)) * 10.0 ** jax.random.uniform(
        k[6], minval=-3.0, maxval=3.0
    )
    matrix = gamma * jnp.eye(n) + skew - skew.T
    c = matrix @ middle  # F(middle) = 0, by cancellation of terms that are not small

    def F(y):
        bump = jnp.exp(-jnp.sum((y - middle) ** 2))
        return jnp.where(weighted, bump + floor, 1.0) * (matrix @ y - c)

    true = jnp.where(weighted, floor * gamma, gamma)
    spread = 10.0 ** jax.random.uniform(k[7], (count, 1), minval=-17.0, maxval=2.0)
    points = middle[None] + spread * jax.random.normal(k[8], (count, n))
    return F, true, points


def _check_true_moduli(cases, seed):
    @jax.jit
    @jax.vmap
    def least(key):
        F, true, points = _random_case(key)
        out = []
        for K in (Box(-1.0, 1.0), dvax.sets.WholeSpace(), Ball(0.0, 2.0)):
            vi = FrozenVI(F, K, dvax.spaces.Euclidean(3))
            out += [found[2] / true for found in _least_moduli(vi, points, true)]
        return jnp.stack(out)

    ratios = np.asarray(least(jax.random.split(jax.random.key(seed), cases)))
    print(
        f"{cases} cases, three sets: least modulus left possible / true modulus {ratios.min():.6f}"
    )
    assert ratios.min() >= 1.0


@pytest.mark.thorough
def test_refute_gamma_never_refutes_a_true_modulus():
    _check_true_moduli(4_000, seed=1)


@pytest.mark.thorough  # 10⁵ operators on three sets, 30 pairs each
def test_refute_gamma_never_refutes_a_true_modulus_in_many_cases():
    _check_true_moduli(100_000, seed=2)
