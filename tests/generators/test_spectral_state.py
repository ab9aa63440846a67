"""States with their spectral coefficients: all operations agree with those on plain states."""

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax.generators import FlowStep
from dvax.generators.spectral_state import coefficients, expand_state, values

g = dvax.generators
WAVES = g.Elliptic(12, 2.0, "periodic", diffusion=0.0, velocity=1.5)
HEAT = g.Elliptic(12, 2.0, "dirichlet")
GENERATORS = {
    "dirichlet": (HEAT, (12,)),
    "dirichlet, long": (g.Elliptic(256, 2.0, "dirichlet"), (256,)),
    "periodic": (WAVES, (12,)),
    "neumann, odd": (g.Elliptic(131, 2.0, "neumann"), (131,)),
    "a square": (g.Elliptic((6, 8), (1.0, 2.0), ("dirichlet", "periodic")), (6, 8)),
    "rotation": (g.Rotation(0.0, WAVES.symbol.imag, WAVES.transform), ((12,), (12,))),
    "components": (
        g.KroneckerSum(HEAT, jnp.array([[-1.0, 0.3], [0.2, -2.0]])), (2, 12)
    ),
    "a product": (g.Product(HEAT, g.Scalar(-1.0)), ((12,), ())),
    "a number": (g.Scalar(-0.5), (7,)),
}  # fmt: skip


NAMES = mostly_thorough(GENERATORS, ["dirichlet, long", "rotation", "components", "a product"])


def state(shape, seed):
    rng = np.random.default_rng(seed)
    if shape and isinstance(shape[0], tuple):
        return tuple(jnp.asarray(rng.normal(size=part)) for part in shape)
    return jnp.asarray(rng.normal(size=shape))


def space_of(x):
    return (
        dvax.spaces.Product(*map(space_of, x))
        if isinstance(x, tuple)
        else dvax.spaces.L2(jnp.full(jnp.shape(x), 0.25))
    )


def close(a, b):
    jtu.tree_map(lambda p, q: np.testing.assert_allclose(p, q, rtol=1e-11, atol=1e-11), a, b)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_spectral_state_step_equals_the_plain_step(name):
    A, shape = GENERATORS[name]
    x0, c0, c1 = (state(shape, seed) for seed in range(3))
    step = A.propagator(jnp.asarray(0.3), 2).step
    plain = step(x0, (c0, c1))
    x1 = step(expand_state(A, x0), (expand_state(A, c0), expand_state(A, c1)))
    close(values(x1), plain)
    # Those that come along are the state's own, and are taken for such.
    close(coefficients(x1), coefficients(expand_state(A, values(x1))))
    again = expand_state(A, values(x1), coefficients(x1))
    close(values(step(again, ())), A.semigroup(0.3, plain))


@pytest.mark.parametrize("name", NAMES)
def test_spectral_state_operations_are_linear(name):
    A, shape = GENERATORS[name]
    a, b = (expand_state(A, state(shape, seed)) for seed in (3, 4))
    both = jtu.tree_map(lambda p, q: 2.0 * p - 0.5 * q, a, b)
    close(both, expand_state(A, values(both)))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_spectral_state_curvature_bound_is_the_same(name):
    A, shape = GENERATORS[name]
    x0, c0, c1 = (state(shape, seed) for seed in range(3))
    space = space_of(x0)
    h = jnp.asarray(0.2)
    x1 = A.propagator(h, 2).step(x0, (c0, c1))
    growth = A.growth(space)
    plain = A.chord_deviation(FlowStep(h, x0, x1, (c0, c1)), space, growth)
    arc = FlowStep(h, *(jtu.tree_map(jnp.asarray, expand_state(A, v)) for v in (x0, x1)),
              tuple(expand_state(A, v) for v in (c0, c1)))  # fmt: skip
    close(A.chord_deviation(arc, space, growth), plain)


@pytest.mark.slow
def test_spectral_state_derivatives_equal_those_of_the_plain_step():
    A, shape = GENERATORS["dirichlet"]
    x0, c0 = state(shape, 0), state(shape, 1)
    w = state(shape, 2)

    def end(x0, h, lift):
        return jnp.sum(w * values(A.propagator(h, 1).step(lift(x0), (lift(c0),))))

    for argnum in (0, 1):
        slope = lambda lift, k=argnum: jax.grad(end, k)(x0, jnp.asarray(0.3), lift)  # noqa: E731
        close(slope(lambda v: expand_state(A, v)), slope(lambda v: v))


@pytest.mark.slow
@pytest.mark.parametrize(
    "how",
    [
        pytest.param(dict(dt=0.02), id="fixed"),
        pytest.param(dict(rtol=1e-4), id="adaptive", marks=pytest.mark.thorough),
    ],
)
def test_exp_rosenbrock_works_without_spectral_states(how):
    # In every step A has another J beside it, and other eigenfunctions.
    problem = dvax.Problem(
        A=HEAT, P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.4),
        f=lambda t, x, u, args: -0.2 * x - u, h=lambda t, x, u, args: 1.0 - 1.5 * x - 0.5 * u,
    )  # fmt: skip
    ends = [
        dvax.solve(problem, jnp.ones(12), 0.0, 0.3, method=method, **how).xs[-1]
        for method in (dvax.ExpRosenbrock(), dvax.ETD4RK())
    ]
    np.testing.assert_allclose(*ends, atol=3e-4)
