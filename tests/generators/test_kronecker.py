"""`KroneckerSum`: field and matrix commute, and the semigroup is the product of both."""

import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
import scipy.linalg
from tests.selection import mostly_thorough

import dvax
from dvax import generators, spaces

RNG = np.random.default_rng(8)
B = RNG.normal(size=(3, 3)) - 1.0 * np.eye(3)
GRID = (5, 4)

FIELDS = {
    "fixed and free ends": generators.Elliptic(GRID, (1.0, 2.0), ("dirichlet", "neumann")),
    "one axis periodic": generators.Elliptic(GRID, 1.0, ("periodic", "neumann"), diffusion=0.3),
    "advection": generators.Elliptic(GRID, 1.0, "periodic", diffusion=0.1, velocity=(1.0, -2.0)),
    "diagonal": generators.Diagonal(-jnp.asarray(RNG.uniform(0.0, 30.0, GRID))),
    "a number": generators.Scalar(-2.0),
}


def matrix_of(A, shape):
    """The dense matrix of A."""
    n = int(np.prod(shape))
    columns = jax.vmap(lambda v: A.apply(v.reshape(shape)).ravel())(jnp.eye(n))
    return np.asarray(columns).T


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(FIELDS, list(FIELDS)[::2]))
def test_kronecker_semigroup_is_the_matrix_exponential(name):
    A = generators.KroneckerSum(FIELDS[name], B)
    shape = (3, *GRID)
    dense = matrix_of(A, shape)
    x0, c0, c1 = RNG.normal(size=(3, *shape))
    flow = jax.jit(lambda h, x, *c: A.propagator(h, 2).step(x, c))
    for h in (0.01, 0.7):
        block = np.zeros((62, 62))
        block[:60, :60] = h * dense
        # (x, 1, θ) with θ' = 1.
        block[:60, 60], block[:60, 61], block[61, 60] = h * c0.ravel(), h * c1.ravel(), 1.0
        exact = (scipy.linalg.expm(block) @ np.r_[x0.ravel(), 1.0, 0.0])[:60]
        found = np.asarray(flow(h, *map(jnp.asarray, (x0, c0, c1)))).ravel()
        np.testing.assert_allclose(found, exact, atol=1e-12 * max(1.0, np.abs(exact).max()))


@pytest.mark.slow
def test_kronecker_parts_commute_and_the_growth_bound_holds():
    field = FIELDS["fixed and free ends"]
    A = generators.KroneckerSum(field, B)
    v = jnp.asarray(RNG.normal(size=(3, *GRID)))
    across = scipy.linalg.expm(0.2 * B)
    apart = jnp.tensordot(
        jnp.asarray(across), jax.vmap(lambda w: field.semigroup(0.2, w))(v), axes=1
    )
    np.testing.assert_allclose(A.semigroup(0.2, v), apart, atol=1e-13)
    bound = A.growth(spaces.Euclidean((3, *GRID)))
    dense = matrix_of(A, (3, *GRID))
    for h in (0.01, 0.3, 2.0):
        norm = np.linalg.norm(scipy.linalg.expm(h * dense), 2)
        assert norm <= float(bound.M) * np.exp(float(bound.omega) * h) * (1 + 1e-12)
    # The logarithmic norm itself, since the two commute and F is self-adjoint.
    exact = np.linalg.eigvalsh(0.5 * (dense + dense.T))[-1]
    assert float(bound.omega) == pytest.approx(exact, rel=1e-12)


@pytest.mark.slow
def test_kronecker_adjoint_is_correct():
    space = spaces.Euclidean((3, *GRID))
    A = generators.KroneckerSum(FIELDS["advection"], B)
    v, w = jnp.asarray(RNG.normal(size=(2, 3, *GRID)))
    left = space.inner(A.semigroup(0.3, v), w)
    assert float(left) == pytest.approx(float(space.inner(v, A.adjoint(space).semigroup(0.3, w))))


@pytest.mark.slow
def test_kronecker_solve_equals_that_of_the_dense_matrix():
    field = generators.Elliptic(6, 1.0, "neumann", diffusion=0.05)
    coupling = np.array([[-0.5, 0.5], [0.3, -0.3]])
    laws = dict(
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.4),
        f=lambda t, x, u, args: 0.3 - u, h=lambda t, x, u, args: 1.2 * x - u,
    )  # fmt: skip
    A = generators.KroneckerSum(field, coupling)
    x0 = RNG.uniform(size=(2, 6))
    dense = dvax.Problem(A=generators.Dense(matrix_of(A, (2, 6))), **laws)
    ends = [
        np.asarray(dvax.solve(problem, start, 0.0, 2.0, dt=0.05).xs[-1]).ravel()
        for problem, start in ((dvax.Problem(A=A, **laws), x0), (dense, x0.ravel()))
    ]
    np.testing.assert_allclose(*ends, atol=1e-12)


@pytest.mark.thorough
def test_kronecker_derivatives_in_the_matrix_and_the_field():
    v = jnp.asarray(RNG.normal(size=(2, 5)))

    def end(coupling, diffusion):
        field = generators.Elliptic(5, 1.0, "dirichlet", diffusion=diffusion)
        return jnp.sum(generators.KroneckerSum(field, coupling).semigroup(0.2, v) ** 3)

    at = jnp.asarray(B[:2, :2]), jnp.asarray(0.1)
    jax.test_util.check_grads(end, at, order=1, modes=("fwd", "rev"), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("shape", [(2, *GRID), (*GRID, 3), ()])
def test_kronecker_rejects_invalid_arguments(shape):
    A = generators.KroneckerSum(FIELDS["fixed and free ends"], B)
    with pytest.raises(dvax.InputError, match="KroneckerSum|Elliptic"):
        A.check(spaces.Euclidean(shape))
