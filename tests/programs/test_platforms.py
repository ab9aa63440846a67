"""Every program can be made for a GPU: JAX lowers for it on a machine without one, and refuses
operations that exist on processors only (a Schur decomposition was one)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.sets.cases import CASES, N

import dvax
from dvax import generators, spaces, vi

MATRIX = np.array([[-1.0, 30.0, 0.0], [0.0, -1.2, 0.5], [0.0, 0.0, -0.9]])
FIVE = spaces.Euclidean(5)
GENERATORS = {
    "Zero": (generators.Zero(), FIVE),
    "Scalar": (generators.Scalar(-2.0), FIVE),
    "Diagonal": (generators.Diagonal(-np.arange(1.0, 6.0)), FIVE),
    "Dense": (generators.Dense(MATRIX), spaces.Euclidean(3)),
    "Dense with a rate": (generators.Dense(MATRIX, omega=-0.5), spaces.L2(np.array([1.0, 2.0, 3.0]))),
    "Elliptic": (
        generators.Elliptic((4, 6), 1.0, ("neumann", "dirichlet")), spaces.L2(np.full((4, 6), 0.1)),
    ),
    "Rotation": (
        generators.Rotation(np.array([-1.0, 0.2]), np.array([3.0, 1.0])),
        spaces.Product(spaces.Euclidean(2), spaces.Euclidean(2)),
    ),
}  # fmt: skip
SOLVERS = {
    "ActiveSet": vi.ActiveSet(), "Bracketing": vi.Bracketing(), "Extragradient": vi.Extragradient(),
    "GoldenRatio": vi.GoldenRatio(), "Lemke": vi.Lemke(), "Projection": vi.Projection(),
    "ForwardBackwardForward": vi.ForwardBackwardForward(), "Newton": vi.SemismoothNewton(),
}  # fmt: skip
METHODS = {
    "ETD4RK": dvax.ETD4RK(), "DormandPrince": dvax.DormandPrince(),
    "ExpRosenbrock": dvax.ExpRosenbrock(), "Picard": dvax.Picard(),
}  # fmt: skip


def lower(run, *arguments):
    """**Raises:** `NotImplementedError` for an operation that a GPU does not have."""
    jax.jit(run).trace(*arguments).lower(lowering_platforms=("cuda",))


def test_an_operation_of_processors_only_is_refused():
    with pytest.raises(NotImplementedError, match="not found for platform cuda"):
        lower(jax.scipy.linalg.schur, jnp.eye(3))


@pytest.mark.parametrize("name", GENERATORS)
def test_generators_have_flows_and_growth_bounds_on_a_gpu(name):
    A, space = GENERATORS[name]
    lower(lambda h, v: (A.semigroup(h, v), A.growth(space), A.apply(v)), 0.1, space.zeros())


@pytest.mark.parametrize("name", CASES)
def test_sets_have_projections_on_a_gpu(name):
    case = CASES[name]
    lower(
        lambda data, v: case.make(data).project(v, spaces.Euclidean(N)),
        jnp.asarray(case.data), jnp.zeros(N),
    )  # fmt: skip


@pytest.mark.parametrize("name", SOLVERS)
def test_inequalities_are_solved_on_a_gpu(name):
    separate = name == "Bracketing"
    law = (lambda y, q: y + y**3 - q) if separate else (lambda y, q: MATRIX.T @ MATRIX @ y + y - q)
    K = dvax.sets.Simplex(1.0) if name == "Lemke" else dvax.sets.Box(-1.0, 1.0)
    lower(lambda q: dvax.solve_vi(law, K, jnp.zeros(3), q, solver=SOLVERS[name]).y, jnp.ones(3))


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_problems_are_solved_on_a_gpu(name):
    # Fixed steps of Picard, which has no others; the rest chooses its steps and measures its defect.
    steps = {"dt": 0.1} if name == "Picard" else {"rtol": 1e-6}
    end = _end(method=METHODS[name], throw=False, **steps)
    lower(end, jnp.ones(3), 2.0)


def test_problems_are_differentiated_on_a_gpu():
    lower(jax.value_and_grad(_end(dt=0.1), argnums=(0, 1)), jnp.ones(3), 2.0)


def _end(**options):
    coupling = jnp.asarray(MATRIX.T @ MATRIX / 900.0)
    problem = dvax.Problem(
        A=generators.Dense(MATRIX), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: args * jnp.sin(t) - u, h=lambda t, x, u, args: x - coupling @ u,
    )  # fmt: skip
    return lambda x0, load: jnp.sum(dvax.solve(problem, x0, 0.0, 1.0, load, **options).xs[-1])
