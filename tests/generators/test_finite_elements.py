"""Consistent mass matrices: linear elements on unstructured random meshes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from jax.experimental.sparse import BCOO
from scipy.spatial import Delaunay
from tests.selection import mostly_thorough

import dvax
from dvax import generators, spaces
from dvax.theory.certificate import is_declared

TRIANGLES = (0.5, 2.0)


def assembled(points, cells):
    """(M, S) of linear elements on a mesh of simplices."""
    n, d = points.shape
    rows, cols, mass, stiffness = [], [], [], []
    for cell in cells:
        edges = points[cell[1:]] - points[cell[0]]
        volume = abs(np.linalg.det(edges)) / np.prod(np.arange(1, d + 1))
        slopes = np.linalg.inv(edges)
        slopes = np.column_stack([-slopes.sum(axis=1), slopes])
        i, j = np.meshgrid(cell, cell, indexing="ij")
        rows.append(i.ravel())
        cols.append(j.ravel())
        mass.append(
            (volume / (d + 1) / (d + 2) * (np.ones((d + 1, d + 1)) + np.eye(d + 1))).ravel()
        )
        stiffness.append((volume * slopes.T @ slopes).ravel())
    place = np.concatenate(rows), np.concatenate(cols)
    make = lambda v: scipy.sparse.coo_array((np.concatenate(v), place), shape=(n, n)).tocsr()  # noqa: E731
    return make(mass), make(stiffness)


def mesh(count=60, seed=1):
    points = np.random.default_rng(seed).uniform(size=(count, 2))
    return points, Delaunay(points).simplices


def rod(n, grading=1.0):
    """(0, 1) with n inner nodes, zero at both ends."""
    nodes = np.linspace(0.0, 1.0, n + 2) ** grading
    cells = np.stack([np.arange(n + 1), np.arange(1, n + 2)], axis=1)
    M, S = assembled(nodes[:, None], cells)
    return nodes[1:-1], M[1:-1, 1:-1], S[1:-1, 1:-1]


MESHES = {
    "triangles": (*assembled(*mesh()), TRIANGLES),
    "a graded rod": (*rod(40, 2.0)[1:], None),
    "a lumped mass": (
        scipy.sparse.diags_array(assembled(*mesh())[0].sum(axis=1)), assembled(*mesh())[1], None,
    ),
}  # fmt: skip


semigroup = jax.jit(lambda A, h, v: A.semigroup(h, v))


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(MESHES, list(MESHES)[:1]))
def test_finite_elements_semigroup_is_that_of_the_pencil(name):
    M, S, interval = MESHES[name]
    A = generators.FiniteElements(M, S, interval, dissipative=True)
    dense = -np.linalg.solve(M.toarray(), S.toarray())
    v = np.random.default_rng(2).normal(size=M.shape[0])
    product = np.asarray(A.apply(jnp.asarray(v)))
    np.testing.assert_allclose(product, dense @ v, atol=1e-11 * np.abs(dense @ v).max())
    for h in (1e-4, 0.01, 1.0):
        found = np.asarray(semigroup(A, h, jnp.asarray(v)))
        np.testing.assert_allclose(found, scipy.linalg.expm(h * dense) @ v, atol=1e-10)
    load = np.asarray(A.load(jnp.asarray(v)))
    np.testing.assert_allclose(M @ load, v, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_finite_elements_mass_eigenvalues_lie_in_the_interval_of_the_element(seed):
    # Wathen's theorem for linear triangles, on which the declared interval rests.
    M, _ = assembled(*mesh(40, seed))
    D = M.diagonal()
    values = scipy.linalg.eigvalsh(M.toarray(), np.diag(D))
    assert TRIANGLES[0] <= values[0] and values[-1] <= TRIANGLES[1] * (1 + 1e-12)


CORNERS = {  # D⁻¹M of one element: of simplices, and of boxes as products of rods
    (0.5, 2.0): (np.ones((3, 3)) + np.eye(3)) / 2,
    (0.5, 2.5): (np.ones((4, 4)) + np.eye(4)) / 2,
    (0.25, 2.25): np.kron([[1, 0.5], [0.5, 1]], [[1, 0.5], [0.5, 1]]),
    (0.125, 3.375): np.kron(
        np.kron([[1, 0.5], [0.5, 1]], [[1, 0.5], [0.5, 1]]), [[1, 0.5], [0.5, 1]]
    ),
}


@pytest.mark.parametrize("interval", CORNERS)
def test_finite_elements_named_intervals_are_those_of_the_elements(interval):
    values = np.linalg.eigvalsh(CORNERS[interval])
    np.testing.assert_allclose([values[0], values[-1]], interval)


@pytest.mark.slow
@pytest.mark.parametrize("name", MESHES)
def test_finite_elements_numerical_range_lies_in_the_rectangle(name):
    M, S, interval = MESHES[name]
    found = generators.FiniteElements(M, S, interval).numerical_range()
    rates = scipy.linalg.eigvalsh(-S.toarray(), M.toarray())
    assert float(found.low) <= rates[0] and rates[-1] <= float(found.high) + 1e-9
    assert float(found.height) <= 1e-9 * abs(float(found.low))


@pytest.mark.slow
def test_finite_elements_growth_bound_holds_in_diagonal_norms():
    M, S, interval = MESHES["triangles"]
    A = generators.FiniteElements(M, S, interval, dissipative=True)
    D = M.diagonal()
    for weights in (D, np.ones_like(D)):
        bound = A.growth(spaces.L2(weights))
        root = np.sqrt(weights)
        for h in (0.001, 0.1, 3.0):
            flow = scipy.linalg.expm(-h * np.linalg.solve(M.toarray(), S.toarray()))
            norm = np.linalg.norm(root[:, None] * flow / root[None, :], 2)
            assert norm <= float(bound.M) * np.exp(float(bound.omega) * h) * (1 + 1e-12)
    assert float(A.growth(spaces.L2(D)).M) == pytest.approx(2.0)


@pytest.mark.slow
def test_finite_elements_adjoint_is_correct():
    M, S, interval = MESHES["triangles"]
    A = generators.FiniteElements(M, S, interval)
    rng = np.random.default_rng(5)
    space = spaces.L2(rng.uniform(0.5, 2.0, M.shape[0]))
    v, w = jnp.asarray(rng.normal(size=(2, M.shape[0])))
    adjoint = A.adjoint(space)
    left, right = space.inner(A.semigroup(0.01, v), w), space.inner(v, adjoint.semigroup(0.01, w))
    assert float(left) == pytest.approx(float(right), rel=1e-11)
    assert float(adjoint.growth(space).M) == pytest.approx(float(A.growth(space).M))


@pytest.mark.thorough
def test_finite_elements_derivatives_in_the_entries_of_both_matrices():
    _, M, S = rod(12)
    place = jnp.asarray(np.stack(M.tocoo().coords, axis=1))
    data, other = (jnp.asarray(v.tocoo().data) for v in (M, S))
    assert (np.stack(S.tocoo().coords, axis=1) == np.asarray(place)).all()
    v = jnp.asarray(np.sin(np.pi * np.arange(1, 13) / 13))

    def end(mass, stiffness):
        matrices = (BCOO((values, place), shape=M.shape) for values in (mass, stiffness))
        A = generators.FiniteElements(*matrices, mass_range=(0.5, 1.5))
        return jnp.sum(A.semigroup(0.05, v) ** 2)

    # Alike for all entries: M → (1 + a)M, S → (1 + b)S is a change of h by b − a.
    by_mass, by_stiffness = jax.jit(jax.grad(end, (0, 1)))(data, other)
    step = 1e-6
    A = generators.FiniteElements(M, S)
    sizes = [float(jnp.sum(A.semigroup(0.05 * (1 + k * step), v) ** 2)) for k in (1, -1)]
    slope = (sizes[0] - sizes[1]) / (2 * step)
    assert float(jnp.sum(by_stiffness * other)) == pytest.approx(slope, rel=1e-7)
    # And one pair of entries beside the diagonal, which M⁻¹ is a polynomial in.
    i, j = np.asarray(place).T
    pair = jnp.asarray(((i == 3) & (j == 4)) | ((i == 4) & (j == 3)), float)
    ends = [float(end(data + k * 1e-7 * pair, other)) for k in (1, -1)]
    slope_of_pair = (ends[0] - ends[1]) / 2e-7
    assert float(jnp.sum(by_mass * pair)) == pytest.approx(slope_of_pair, rel=1e-5)
    assert float(jnp.sum(by_mass * data)) == pytest.approx(-slope, rel=1e-7)


@pytest.mark.thorough
def test_finite_elements_cooling_rod_has_order_two_in_the_mesh():
    errors = []
    for n in (9, 19, 39):
        nodes, M, S = rod(n)
        A = generators.FiniteElements(M, S)
        problem = dvax.Problem(
            A=A, P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.4),
            f=lambda t, x, u, args: args - u, h=lambda t, x, u, args: 1.0 + x - u,
            state_space=spaces.L2(M.diagonal()),
        )  # fmt: skip
        # Held above at 0.4 all along: x = sin πs and a load that replaces what flows away.
        load = jnp.asarray(np.pi**2 * np.sin(np.pi * nodes) + 0.4)
        sol = dvax.solve(problem, np.sin(np.pi * nodes), 0.0, 0.5, load, dt=0.25)
        errors.append(np.abs(np.asarray(sol.xs[-1]) - np.sin(np.pi * nodes)).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 1.85).all()


def test_finite_elements_bound_from_a_declared_interval_is_declared():
    M, S, interval = MESHES["triangles"]
    assert is_declared(generators.FiniteElements(M, S, interval))
    assert is_declared(generators.FiniteElements(*rod(10)[1:], dissipative=True))
    assert not is_declared(generators.FiniteElements(*rod(10)[1:]))


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda M, S: generators.FiniteElements(M, S), "tetrahedra"),
        (lambda M, S: generators.FiniteElements(M, S[:-1, :-1], TRIANGLES), "same unknowns"),
        (lambda M, S: generators.FiniteElements(M.toarray(), S), "sparse"),
        (lambda M, S: generators.FiniteElements(-M, S, TRIANGLES), "must be positive"),
        (
            lambda M, S: generators.FiniteElements(M + scipy.sparse.triu(M), S, TRIANGLES),
            "symmetric",
        ),
        (lambda M, S: generators.FiniteElements(M, S, (0.0, 2.0)), "mass_range"),
    ],
)
def test_finite_elements_rejects_invalid_arguments(make, word):
    M, S, _ = MESHES["triangles"]
    with pytest.raises(dvax.InputError, match=word):
        make(M, S)
