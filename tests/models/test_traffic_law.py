"""The law of day-to-day traffic on link flows: against a first-order method that shares no code."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.models import traffic_networks as networks
from tests.selection import mostly_thorough

import dvax
from dvax.models import traffic
from dvax.models.traffic import law
from dvax.vi import RESULTS, Accelerated, FrozenVI

SHAPES = {
    "square": dict(rows=5, columns=5, zones=8, pairs=30, load=3e4, seed=1),
    "long": dict(rows=3, columns=12, zones=10, pairs=40, load=2e4, seed=2),
    "one way": dict(rows=6, columns=6, zones=9, pairs=50, load=6e4, seed=3, one_way=True),
    "empty roads": dict(rows=4, columns=5, zones=6, pairs=15, load=1e2, seed=4),
    "jammed": dict(rows=4, columns=4, zones=6, pairs=20, load=2e5, seed=5),
}
EVERY = [(s, d, r) for s in SHAPES for d in (0.5, 1.0, 2.0) for r in (1e-3, 1e-1, 1.0, 10.0)]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("shape", "factor", "share"),
    mostly_thorough(EVERY, [("one way", 2.0, 0.1)]),
)
def test_link_newton_agrees_with_accelerated_gradients(shape, factor, share):
    network, trips = networks.grid(**SHAPES[shape])
    trips = traffic.Trips(trips.zones, trips.origin, trips.destination, factor * trips.flow)
    usual = traffic.Traffic(network, trips)
    model = traffic.Traffic(network, trips, rho=share * usual.rho)
    problem, newton = model.problem, model.vi_solver
    # To what rounding allows: `least` is no help.
    newton = dataclasses.replace(newton, least=0.0)
    first_order = Accelerated(max_steps=200_000)

    def solved(x, solver, tol):
        space = problem.spaces(x)[1]
        vi = FrozenVI(problem.frozen(0.0, x), problem.set_at(0.0), space, 1.0, model.constants.L_F)
        return solver.solve(vi, x, tol)

    ours = jax.jit(lambda x: solved(x, newton, 0.0))
    theirs = jax.jit(lambda x, tol: solved(x, first_order, tol))
    x = model.all_or_nothing()
    for _ in range(3):
        one = ours(x)
        assert one.result == RESULTS.successful
        other = theirs(x, jnp.maximum(one.residual, 1e-10 * jnp.sum(trips.flow)))
        # Both lie within their ‖w‖ of the solution, as γ = 1.
        apart = float(jnp.linalg.norm(one.y - other.y))
        assert apart <= float(one.residual + other.residual) * (1 + 1e-9)
        assert int(one.iterations) <= 60
        x = x + 0.5 * (one.y - x)


@pytest.mark.slow
def test_link_newton_block_is_that_of_the_dense_matrix():
    # S = Δ P Δᵀ, P = diag(used) − mean over the used paths of a pair, of dense matrices.
    model = traffic.Traffic(*networks.grid(**SHAPES["one way"]))
    choices, rng = model.vi_solver.choices, np.random.default_rng(6)
    rows, pair = len(choices.rows), np.asarray(choices.pair)
    along = np.zeros((rows, model.paths.count))
    along[np.asarray(choices.incidence.path), np.asarray(choices.incidence.link)] = 1.0
    used = (rng.uniform(size=rows) < 0.6).astype(float)
    count = np.maximum(np.bincount(pair, used), 1.0)
    P = np.diag(used) - np.where(pair[:, None] == pair, np.outer(used, used), 0.0) / count[pair]
    S = along.T @ P @ along
    block = np.asarray(choices.block)
    assert len(block) > 20 and used.sum() > 15
    found = choices.matrix(jnp.asarray(used), jnp.asarray(count))
    np.testing.assert_allclose(np.tril(found), np.tril(S[np.ix_(block, block)]), atol=1e-13)
    link, path = np.asarray(choices.incidence.link), np.asarray(choices.incidence.path)
    diagonal = law._diagonal(pair, path, link, used, model.paths.count)
    np.testing.assert_allclose(diagonal, np.diag(S), atol=1e-13)


def test_link_newton_rejects_another_law():
    solver = traffic.Traffic(*networks.two_roads(), rho=10.0).vi_solver
    with pytest.raises(dvax.InputError, match="Traffic alone"):
        dvax.solve_vi(lambda y, args: y, dvax.sets.Simplex(1.0), jnp.ones(2), solver=solver)


@pytest.mark.thorough
def test_link_newton_solves_pairs_without_a_choice():
    network = traffic.Network(
        zones=2, nodes=2, first_thru_node=1, init_node=[1, 2], term_node=[2, 1],
        capacity=[10.0, 10.0], length=[1.0, 1.0], free_flow_time=[5.0, 5.0], b=[0.15, 0.15],
        power=[4.0, 4.0],
    )  # fmt: skip
    model = traffic.Traffic(network, traffic.Trips(2, [1], [2], [10.0]))
    u = model.problem.response(0.0, jnp.array([3.0]), solver=model.vi_solver)
    np.testing.assert_allclose(u, [10.0], rtol=1e-15)
