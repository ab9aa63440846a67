"""What dvax computes on an accelerator as on a processor."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax.experimental.sparse import BCOO

import dvax
from dvax.models.rough_contact import RoughContact

from .contact_law import strip
from .rough_surface import surface

Call = Callable[[], Any]
"""Computes, and returns numbers by which two platforms are compared."""


class Workload(NamedTuple):
    """`make()` prepares a call: arrays on the device, functions compiled when it is first called."""

    what: str
    make: Callable[[], Call]


def _field(points: int, steps: int, **settings: Any) -> Call:
    law = strip(points)
    start = jnp.asarray(law.start)
    span: dict[str, Any] = {"t1": 1e-3 * steps, "dt": 1e-3} | settings

    return lambda: jax.block_until_ready(dvax.solve(law.model.problem, start, 0.0, **span).xs)[-1]


def _gradient(points: int, steps: int) -> Call:
    law = strip(points)
    start = jnp.asarray(law.start)

    @jax.jit
    def slope(x: Any) -> Any:
        end = lambda x: jnp.mean(  # noqa: E731
            dvax.solve(law.model.problem, x, 0.0, 1e-3 * steps, dt=1e-3).xs[-1] ** 2
        )
        return jax.grad(end)(x)

    return lambda: points * jax.block_until_ready(slope(start))


def _heat(side: int, steps: int) -> Call:
    problem = dvax.Problem(
        A=dvax.generators.Elliptic((side, side), 1.0, "dirichlet"),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.4),
        f=lambda t, x, u, args: 0.2 - u, h=lambda t, x, u, args: 1.0 - 1.5 * x - 0.5 * u,
    )  # fmt: skip
    x0 = jnp.asarray(np.random.default_rng(0).normal(size=(side, side)))
    run = jax.jit(lambda x: dvax.solve(problem, x, 0.0, 1e-3, dt=1e-3 / steps).xs[-1])
    return lambda: jax.block_until_ready(run(x0))


def conduction(side: int) -> tuple[Any, Any, np.ndarray]:
    """Heat on a grid as a sparse matrix with its rate in args, with a limited heater at each point."""
    line = scipy.sparse.diags([1.0, -2.0, 1.0], [-1, 0, 1], shape=(side, side)) * side**2
    heat = BCOO.from_scipy_sparse(scipy.sparse.kronsum(line, line))
    n = side**2
    problem = dvax.Problem(
        A=lambda rate: dvax.generators.Sparse(BCOO((rate * heat.data, heat.indices), shape=(n, n))),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 2.0),
        f=lambda t, x, u, rate: u - x, h=lambda t, x, u, rate: 5.0 * (1.0 - x),
    )  # fmt: skip
    return problem, jnp.asarray(0.05), np.random.default_rng(4).uniform(0.0, 1.0, n)


def _sparse(side: int, steps: int) -> Call:
    problem, rate, x0 = conduction(side)
    start, span = jnp.asarray(x0), 0.1
    run = jax.jit(
        lambda rate: dvax.solve(problem, start, 0.0, span, args=rate, dt=span / steps).xs[-1]
    )
    return lambda: jax.block_until_ready(run(rate))


def _sparse_gradient(side: int, steps: int) -> Call:
    problem, rate, x0 = conduction(side)
    start, span = jnp.asarray(x0), 0.1
    mean = lambda rate: jnp.mean(  # noqa: E731
        dvax.solve(problem, start, 0.0, span, args=rate, dt=span / steps).xs[-1]
    )
    run = jax.jit(jax.grad(mean))
    return lambda: jax.block_until_ready(run(rate))


def _rough(n: int) -> Call:
    heights = surface(n)
    model = RoughContact(
        profile=heights, lengths=1.0, modulus=1.0, thickness=0.1, approach=0.0
    )  # fmt: skip
    approach = 0.5 * float(heights.max() - heights.mean())
    return lambda: jax.block_until_ready(model.equilibrium(approach).y)


def _ensemble(members: int) -> Call:
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: args - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip
    loads = np.linspace(2.0, 4.0, members)
    return lambda: np.asarray(
        dvax.ensemble(problem, -1.0, 0.0, 2.0, loads, axes=(None, 0), rtol=1e-6, atol=1e-9).values
    )


def _boxes(count: int, n: int) -> Call:
    rng = np.random.default_rng(1)
    half, skew = rng.normal(size=(2, n, n))
    matrix = jnp.asarray(half @ half.T / n + 0.1 * np.eye(n) + (skew - skew.T) / np.sqrt(n))
    loads = jnp.asarray(3.0 * rng.normal(size=(count, n)))

    def one(q: Any) -> Any:
        law = lambda y, q: matrix @ y - q  # noqa: E731
        return dvax.solve_vi(law, dvax.sets.Box(-1.0, 1.0), jnp.zeros(n), args=q, gamma=0.1).y

    run = jax.jit(jax.vmap(one) if count > 1 else lambda q: one(q[0]))
    return lambda: jax.block_until_ready(run(loads))


def _pointwise(points: int) -> Call:
    c = jnp.asarray(np.random.default_rng(2).uniform(-12.0, 12.0, points))
    space, box = dvax.spaces.Euclidean(points), dvax.sets.Box(-2.0, 2.0)

    @jax.jit
    def run(c: Any) -> Any:
        vi = dvax.vi.FrozenVI(lambda y: y + y**3 - c, box, space)
        return dvax.vi.Bracketing().solve(vi, jnp.zeros(points), 0.0).y

    return lambda: jax.block_until_ready(run(c))


def _simplices(count: int, n: int) -> Call:
    values = jnp.asarray(np.random.default_rng(3).normal(size=count * n))
    simplices = dvax.sets.Simplex(jnp.ones(count), sizes=(n,) * count)
    run = jax.jit(lambda v: simplices.project(v, dvax.spaces.Euclidean(count * n)))
    return lambda: jax.block_until_ready(run(values))


WORKLOADS = {
    "field 1e5": Workload("10⁵ contact points, 200 fixed steps, as called", lambda: _field(10**5, 200)),
    "field 1e6": Workload("10⁶ contact points, 200 fixed steps, as called", lambda: _field(10**6, 200)),
    "field 1e7": Workload("10⁷ contact points, 20 fixed steps, as called", lambda: _field(10**7, 20)),
    "bound 1e6": Workload(
        "10⁶ contact points, 200 fixed steps, the defect measured",
        lambda: _field(10**6, 200, measure=True),
    ),
    "adaptive 1e5": Workload(
        "10⁵ contact points to rtol 1e-6, the default method",
        lambda: _field(10**5, 1000, dt=None, rtol=1e-6),
    ),
    "gradient 1e5": Workload(
        "gradient by x₀ of 10⁵ points and 200 steps", lambda: _gradient(10**5, 200)
    ),
    "heat": Workload(
        "heat on 1024 × 1024 points with a saturated law, 20 steps", lambda: _heat(1024, 20)
    ),
    "sparse": Workload(
        "heat on 256 × 256 points by a sparse matrix, 20 steps", lambda: _sparse(256, 20)
    ),
    "sparse gradient": Workload(
        "its gradient by the entries of the matrix", lambda: _sparse_gradient(256, 20)
    ),
    "rough": Workload("a rough surface of 1024 × 1024 points in contact", lambda: _rough(1024)),
    "ensemble": Workload("10⁵ members of C1 to rtol 1e-6", lambda: _ensemble(10**5)),
    "box": Workload("one dense inequality on a box, n = 1000", lambda: _boxes(1, 1000)),
    "boxes": Workload("512 dense inequalities on boxes, n = 100", lambda: _boxes(512, 100)),
    "pointwise": Workload("10⁶ nonlinear laws on intervals", lambda: _pointwise(10**6)),
    "simplices": Workload("10⁵ simplices of 20 entries", lambda: _simplices(10**5, 20)),
    "point": Workload("one contact point, 200 fixed steps, as called", lambda: _field(1, 200)),
}  # fmt: skip
