"""Systems with a manufactured solution, for any set, operator and generator.

With a smooth x*, any curve z* and y* = proj_K(z*), u* = P⁻¹y*, ξ* = z* − y* ∈ N_K(y*),

    h(t, x, u) = H_x (x − x*) + H_u (u − u*) + u* + ξ*,
    f(t, x, u) = F_x (x − x*) + F_u (u − u*) + x*′ − A x*

have the solution (x*, u*), which hugs the boundary of K and leaves it where z* says so. Only y* comes
out of the set's own projection, which the sets' tests hold against its definition.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import dvax
from dvax import generators, operators, sets, spaces

M = 4
"""Unknowns of the law."""


class Manufactured(NamedTuple):
    problem: dvax.Problem
    x0: Any
    error: Any
    exact: Any


def _wave(n: int) -> np.ndarray:
    return (np.arange(n) + 0.5) * np.pi / n


FAR = np.array([[-1.0, 30.0, 0.0], [0.0, -1.3, 5.0], [0.0, 0.0, -2.0]])
STIFF = jnp.array([1.0, 0.1, 2e-3])
"""What A multiplies by much is small in x*, as in a smooth field: stiff orders are for that."""
FIELD = jnp.cos(_wave(16))
GENERATORS = {
    "Zero": (generators.Zero(), 3),
    "Scalar": (generators.Scalar(-1.5), 3),
    "Diagonal, stiff": (generators.Diagonal(jnp.array([-0.5, -40.0, -2e3])), STIFF),
    "Dense, far from normal": (generators.Dense(FAR), 3),
    "Rotation": (generators.Rotation(jnp.array([0.0, -0.1]), jnp.array([1.0, 30.0])), (2, 2)),
    "Elliptic": (generators.Elliptic(16, np.pi, boundary="neumann"), FIELD),
    "Product": (generators.Product(generators.Scalar(-1.0), generators.Dense(FAR)), (2, 3)),
}

ROOT = np.random.default_rng(3).normal(size=(M, M))
OPERATORS = {
    "Scaling": operators.Scaling(0.7),
    "Diagonal": operators.Diagonal(jnp.array([0.6, 1.0, 1.5, 2.0])),
    "Dense": operators.Dense(0.15 * ROOT @ ROOT.T + np.eye(M)),
}

SETS = {
    "Box": lambda t: sets.Box(-0.5 * jnp.exp(-t), 0.6 + 0.1 * jnp.sin(t)),
    "Ball": lambda t: sets.Ball(jnp.full(M, 0.1) * t, 1.0 - 0.2 * t),
    "HalfSpace": lambda t: sets.HalfSpace(jnp.arange(1.0, M + 1.0), 0.3 * t),
    "Simplex": lambda t: sets.Simplex(1.0 + 0.3 * jnp.cos(t)),
    "SecondOrderCone": lambda t: sets.SecondOrderCone(0.7 + 0.1 * t),
    "L1Ball": lambda t: sets.L1Ball(0.1 * t, 0.9),
    "Ellipsoid": lambda t: sets.Ellipsoid(0.0, radii=jnp.arange(1.0, M + 1.0) / (3.0 + t)),
    "Polyhedron": lambda t: sets.Polyhedron(ROOT, 0.4 + 0.1 * jnp.sin(t + jnp.arange(1.0 * M))),
    "WholeSpace": lambda t: sets.WholeSpace(),
}  # fmt: skip


def manufactured(generator: str, operator: str, kind: str) -> Manufactured:
    A, like = GENERATORS[generator]
    P, K = OPERATORS[operator], SETS[kind]
    space = spaces.Euclidean(M)
    if isinstance(like, int | tuple):
        # Each entry turns at its own pace.
        shapes = like if isinstance(like, tuple) else (like,)
        parts = tuple(jnp.arange(1.0, n + 1.0) / n for n in shapes)
        x_star = lambda t: tuple(jnp.sin(p * t + p) for p in parts)  # noqa: E731
        if isinstance(like, int):
            chosen = lambda t: x_star(t)[0]  # noqa: E731
        else:
            chosen = x_star
    else:
        chosen = lambda t: (jnp.exp(-t) + 0.3 * jnp.cos(2 * t)) * like  # noqa: E731
    x0, shape_back = ravel_pytree(chosen(0.0))
    n = len(x0)
    rng = np.random.default_rng(n)
    F_x, F_u, H_x = (
        jnp.asarray(size * rng.normal(size=shape) / np.sqrt(shape[1]))
        for size, shape in ((0.4, (n, n)), (0.8, (n, M)), (0.8, (M, n)))
    )
    H_u = -0.5 * np.eye(M)
    if operator != "Scaling":
        H_u = H_u + 0.3 * (ROOT - ROOT.T) - 0.1 * np.diag(np.arange(M))
    H_u = jnp.asarray(H_u)
    phase = 1.3 * jnp.arange(1.0 * M)

    def law(t):
        z = 1.2 * jnp.sin(2.5 * t + phase) + 0.2
        y = K(t).project(z, space)
        return P.inverse(y), z - y

    def away(t, x, u):
        u_star, _ = law(t)
        return ravel_pytree(x)[0] - ravel_pytree(chosen(t))[0], u - u_star

    def h(t, x, u, args):
        (dx, du), (u_star, xi) = away(t, x, u), law(t)
        return H_x @ dx + H_u @ du + u_star + xi

    def f(t, x, u, args):
        dx, du = away(t, x, u)
        x_star, rate = jax.jvp(chosen, (t,), (jnp.ones_like(t),))
        drift = jax.tree_util.tree_map(jnp.subtract, rate, A.apply(x_star))
        return jax.tree_util.tree_map(jnp.add, shape_back(F_x @ dx + F_u @ du), drift)

    problem = dvax.Problem(
        A=A, P=P, K=lambda t, args: K(t), f=f, h=h, control_space=space,
        state_space=_space(chosen(0.0)),
    )  # fmt: skip

    def error(sol):
        """(of x, of u): the worst of the saved times."""
        flat = lambda tree: ravel_pytree(tree)[0]  # noqa: E731
        off_x = jax.vmap(lambda t, x: jnp.max(jnp.abs(flat(x) - flat(chosen(t)))))(sol.ts, sol.xs)
        off_u = jax.vmap(lambda t, u: jnp.max(jnp.abs(u - law(t)[0])))(sol.ts, sol.us)
        return float(jnp.max(off_x)), float(jnp.max(off_u))

    return Manufactured(problem, chosen(0.0), error, chosen)


def _space(x: Any) -> Any:
    if isinstance(x, tuple):
        return spaces.Product(*(spaces.Euclidean(p.shape) for p in x))
    return spaces.Euclidean(x.shape)
