"""Partial evaluation: the same values and derivatives, and constants computed once."""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax._jax.jaxprs import has_loop
from dvax._jax.known_functions import operation
from dvax.programs.partial_evaluation import PartialEvaluation


@jax.custom_jvp
def _doubled(v):
    return 2.0 * v


_doubled.defjvp(lambda primals, tangents: (_doubled(*primals), 7.0 * tangents[0]))

M = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3)))
FUNCTIONS = {
    "constant": lambda t, a: {"y": a["v"] @ M},
    "the argument itself": lambda t, a: (t, a["v"]),
    "product": lambda t, a: t * jnp.sum(jnp.exp(a["v"])) + a["s"],
    "inner function": lambda t, a: jax.jit(lambda t, v: (jnp.sin(t), jnp.cos(v)))(t, a["v"]),
    "loop": lambda t, a: jax.lax.fori_loop(0, 3, lambda k, v: v * t + a["s"], a["v"]),
    "condition": lambda t, a: jax.lax.cond(t > 0.3, lambda: a["v"], lambda: t * a["v"]),
    "derivative rule": lambda t, a: _doubled(t * a["s"]) + _doubled(a["s"]),
}


@pytest.mark.parametrize("fn", FUNCTIONS.values(), ids=FUNCTIONS)
def test_values_and_derivatives_are_those_of_the_function(fn):
    args = {"v": jnp.array([0.3, -1.0, 2.0]), "s": jnp.asarray(0.7)}

    def partly(t, args):
        return PartialEvaluation.of(lambda t: fn(t, args), jnp.zeros(()))(t)

    for t in (0.0, 0.4, 3.0):
        point = jnp.asarray(t), args
        for transform in (lambda f: f, jax.jacfwd, jax.jacrev, lambda f: jax.jacfwd(f, argnums=1)):
            found, expected = transform(partly)(*point), transform(fn)(*point)
            assert jax.tree.structure(found) == jax.tree.structure(expected)
            assert all(map(np.allclose, jax.tree.leaves(found), jax.tree.leaves(expected)))


def test_a_table_stays_the_function_that_other_rules_know():
    table = dvax.signals.Table(np.arange(4.0), np.array([0.0, 2.0, 1.0, 3.0]))
    part = PartialEvaluation.of(lambda t: dvax.sets.Box(0.0, table(t)), jnp.zeros(()))
    names = [operation(eqn) for eqn in jax.make_jaxpr(part)(1.0).eqns]
    assert "dvax_linear_table" in names


def test_what_does_not_depend_on_t_is_computed_before():
    part = PartialEvaluation.of(lambda t: t * jnp.linalg.norm(M @ M) + jnp.trace(M), jnp.zeros(()))
    assert len(jax.make_jaxpr(part)(1.0).eqns) == 2


def _supplies(e, d=5.0, G=None):
    """Three supplies that meet a demand e."""
    G = jnp.vstack([jnp.eye(3), -jnp.eye(3)]) if G is None else G
    return dvax.sets.Polyhedron(G, jnp.broadcast_to(d, 6), jnp.ones((1, 3)), jnp.reshape(e, 1))


@pytest.mark.parametrize("weights", [None, np.array([1.0, 2.0, 5.0])])
def test_prepared_polyhedron_has_the_projection_and_derivatives_of_the_polyhedron(weights):
    space = dvax.spaces.Euclidean(3) if weights is None else dvax.spaces.L2(weights=weights)

    def ends(prepare, z, e, d, G):
        K = _supplies(e, d, G)
        K = K.prepared(z, space) if prepare else K
        return K.project(z, space), K.switches(z, space)[0]

    @jax.jit
    def both(*data):
        value, derivative = (lambda f: f), (lambda f: jax.jacfwd(f, argnums=(0, 1, 2, 3)))
        return [
            [of(partial(ends, way))(*data) for of in (value, derivative)] for way in (True, False)
        ]

    rng = np.random.default_rng(1)
    G = jnp.asarray(np.vstack([np.eye(3), rng.normal(size=(3, 3))]))
    for _ in range(10):
        found, expected = both(
            jnp.asarray(rng.normal(size=3) * 3.0), 1.0, jnp.asarray(rng.uniform(0.5, 2.0, 6)), G
        )
        assert all(map(np.allclose, jax.tree.leaves(found), jax.tree.leaves(expected)))


@pytest.mark.parametrize("bound", [np.nan, -np.inf])
def test_projection_onto_a_polyhedron_with_an_impossible_traced_bound_is_nan(bound):
    @jax.jit
    def project(d):
        return dvax.sets.Polyhedron(jnp.eye(2), d).project(jnp.zeros(2), dvax.spaces.Euclidean(2))

    assert np.all(np.isnan(project(jnp.array([1.0, bound]))))
    assert np.array_equal(project(jnp.array([1.0, np.inf])), np.zeros(2))


def test_pseudoinverse_of_the_equations_is_computed_once_a_run():
    """Also where the demand moves: then the equations do, but not their matrix."""
    for K in (_supplies(1.0), lambda t, args: _supplies(1.0 + 0.2 * jnp.sin(t))):
        problem = dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=K,
            f=lambda t, x, u, args: u, h=lambda t, x, u, args: 1.0 - 2.0 * x,
        )  # fmt: skip
        set_at = PartialEvaluation.of(
            lambda t, problem=problem: problem.set_at(t).prepared(
                jnp.zeros(3), dvax.spaces.Euclidean(3)
            ),
            jnp.zeros(()),
        )
        assert not has_loop(jax.make_jaxpr(set_at)(0.3))


@pytest.mark.slow
def test_gradient_through_a_moving_polyhedron_agrees_with_differences():
    def total(scale):
        problem = dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
            K=lambda t, args: _supplies(args["e"] * (1.0 + 0.2 * jnp.sin(t)), args["d"] * 0.6),
            f=lambda t, x, u, args: jnp.array([1.0, 2.0, 3.0]) * u,
            h=lambda t, x, u, args: args["h"] - 2.0 * x,
        )  # fmt: skip
        args = {"e": scale[0], "d": scale[1], "h": scale[2]}
        sol = dvax.solve(problem, jnp.array([0.3, 0.1, -0.2]), 0.0, 2.0, args, rtol=1e-9, atol=1e-9)
        return jnp.sum(sol.xs[-1] ** 2)

    at, size = jnp.array([1.0, 0.9, 0.5]), 1e-5
    differences = [(total(at + size * e) - total(at - size * e)) / (2 * size) for e in np.eye(3)]
    assert np.allclose(jax.grad(total)(at), differences, rtol=1e-5, atol=1e-6)


class _MovingHalfPlane(dvax.sets.AbstractSet):
    """{y : y₀ ≤ b}, where b is the value of a function that has the time in its closure."""

    bound: Callable[[], jax.Array] = eqx.field(static=True)

    def project(self, z, space):
        return z.at[0].min(self.bound())

    def switches(self, z, space):
        return [self.bound() - z[0]]

    def intervals(self, like):
        return None

    def check(self, like):
        pass


@pytest.mark.slow
def test_a_set_of_a_user_may_hold_a_function_of_time():
    """Its structure contains a traced value, and must not be used after the call that made it."""
    mixed = jnp.array([[1.0, 0.4], [-0.2, 1.0]])

    def end(K):
        problem = dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Dense(jnp.array([[2.0, 0.3], [0.3, 1.0]])),
            K=K, f=lambda t, x, u, args: u, h=lambda t, x, u, args: 1.0 - mixed @ x,
        )  # fmt: skip
        return dvax.solve(problem, jnp.array([0.3, 0.1]), 0.0, 2.0, rtol=1e-8, atol=1e-8).xs[-1]

    expected = end(
        lambda t, args: dvax.sets.HalfSpace(jnp.array([1.0, 0.0]), 0.5 + 0.3 * jnp.sin(t))
    )
    found = end(lambda t, args: _MovingHalfPlane(lambda: 0.5 + 0.3 * jnp.sin(t)))
    assert np.allclose(found, expected, atol=1e-6)
