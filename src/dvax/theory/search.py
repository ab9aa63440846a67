"""Sampling and ascent over a region: what refutes a modulus, or says how large it is at the least."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..programs.slope import Slope
from ..spaces import AbstractSpace
from .region import Region
from .system import System
from .weights import flat_roots, whole

POINTS, ROUNDS = 256, 60
"""Of a search: how many starts, and how many steps of ascent."""

_ENTRIES = 2_000_000
"""Of all points of a search together: in many dimensions there are fewer of them."""

_ROUNDING = 1e4
_DENSE = 64


class Pair(NamedTuple):
    """Where the law stands still at (t, x), two points y and z of K(t) with ⟨F(y), z − y⟩ ≥ 0 and
    ⟨F(z), z − y⟩ < γ‖z − y‖² for every γ above `gamma`."""

    t: float
    x: Tree
    y: Tree
    z: Tree
    gamma: float
    forward: float
    backward: float


def steepest(system: System, region: Region, name: str, by: str) -> float:
    """The largest ‖∂f/∂x‖ (name "f", by "x") and the like that a search finds in a bounded region,
    slopes between near and far points included: a bound from below on the modulus."""
    fn = getattr(system.problem, name)
    out = system.state if name == "f" else system.control
    into = system.state if by == "x" else system.control
    of = lambda t, x, u: fn(t, x, u, system.args)  # noqa: E731
    one = lambda t, x, u, v: of(t, v, u) if by == "x" else of(t, x, v)  # noqa: E731

    def norm(point: tuple) -> jax.Array:
        t, x, u = point
        return _norm(partial(one, t, x, u), x if by == "x" else u, out, into)

    low, high = _bounds(region)
    starts = _points(low, high, POINTS, 1)
    best = _ascend(norm, starts, low, high)
    others = _points(low, high, POINTS, 2)
    mixed = []
    for reach in (1.0, 1e-3, 1e-6):
        k = 1 if by == "x" else 2
        there = jtu.tree_map(lambda a, b, r=reach: a + r * (b - a), starts[k], others[k])
        mixed.append(jax.vmap(lambda p, v: _quotient(one, p, v, out, into, by))(starts, there))
    slopes = jnp.concatenate([best, *mixed])
    return float(jnp.max(jnp.where(jnp.isfinite(slopes), slopes, 0.0)))


def counterexample(system: System, region: Region) -> Pair | None:
    """Two points that no strongly pseudomonotone F can have, searched for in a bounded region; with a
    modulus `gamma` below zero, so that it refutes every positive one. None where none was found."""
    low, high = _bounds(region)
    P, space, args = system.problem.operator(system.args), system.control, system.args

    def points(v: tuple) -> tuple[Tree, Tree, Tree, Tree]:
        t, x, u, w = v
        K = system.problem.set_at(t, args)
        y, z = K.project(P.apply(u), space), K.project(P.apply(w), space)
        F = system.problem.frozen(t, x, args)
        return y, z, F(y), F(z)

    def modulus(v: tuple) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        y, z, Fy, Fz = points(v)
        d = _tree.sub(z, y)
        forward, backward = space.inner(Fy, d), space.inner(Fz, d)
        room = space.norm(Fy) + space.norm(Fz)
        return forward, backward, space.norm(d), room

    def escape(v: tuple) -> jax.Array:
        forward, backward, length, _ = modulus(v)
        gain = jnp.minimum(forward, -backward)
        return jnp.where(length > 1e-6, gain / jnp.maximum(length, 1e-6) ** 2, -jnp.inf)

    t, x, u = low
    ends = (t, x, u, u), (high[0], high[1], high[2], high[2])
    found = _climb(escape, _points(*ends, 4 * POINTS, 3), *ends)
    forward, backward, length, room = jax.vmap(modulus)(found)
    eps = float(jnp.finfo(length.dtype).eps)
    gain = jnp.minimum(forward, -backward) - _ROUNDING * eps * room * length
    gain = jnp.where((length > 1e-6) & jnp.isfinite(gain), gain, -jnp.inf)
    k = int(jnp.argmax(gain))
    if not float(gain[k]) > 0:
        return None
    worst = jtu.tree_map(lambda leaf: leaf[k], found)
    y, z, *_ = points(worst)
    return Pair(
        float(worst[0]), worst[1], y, z, float(backward[k] / length[k] ** 2), float(forward[k]),
        float(backward[k]),
    )  # fmt: skip


def least_modulus(system: System, region: Region) -> float:
    """The least ⟨F(y) − F(z), y − z⟩/‖y − z‖² that a search finds: what γ may be at the most, where F
    is strongly monotone."""
    P, space, args = system.problem.operator(system.args), system.control, system.args
    low, high = _bounds(region)

    def minus(v: tuple) -> jax.Array:
        t, x, u, w = v
        K = system.problem.set_at(t, args)
        F = system.problem.frozen(t, x, args)
        y, z = K.project(P.apply(u), space), K.project(P.apply(w), space)
        d = _tree.sub(y, z)
        push, square = space.inner(_tree.sub(F(y), F(z)), d), space.inner(d, d)
        return jnp.where(square > 1e-12, -push / jnp.maximum(square, 1e-12), -jnp.inf)

    ends = (*low, low[2]), (*high, high[2])
    found = _climb(minus, _points(*ends, POINTS, 4), *ends)
    values = jax.vmap(minus)(found)
    return -float(jnp.max(jnp.where(jnp.isfinite(values), values, -jnp.inf)))


def _ascend(norm: Callable, starts: Any, low: Any, high: Any) -> jax.Array:
    return jax.vmap(norm)(_climb(norm, starts, low, high))


def _climb(value: Callable[[Any], jax.Array], starts: Any, low: Any, high: Any) -> Any:
    """Steps uphill, each of a shrinking share of the region's width, kept where they help."""
    width = jtu.tree_map(jnp.subtract, high, low)

    def step(k: Any, carry: tuple) -> tuple:
        point, best = carry
        share = 0.3 * 0.9**k
        new = jtu.tree_map(
            lambda p, g, w, a, b: jnp.clip(p + share * w * jnp.sign(jnp.nan_to_num(g)), a, b),
            point, jax.grad(value)(point), width, low, high,
        )  # fmt: skip
        reached = value(new)
        better = reached > best
        return _tree.where(better, new, point), jnp.where(better, reached, best)

    def climb(point: Any) -> Any:
        return jax.lax.fori_loop(0, ROUNDS, step, (point, value(point)))[0]

    return jax.jit(jax.vmap(climb))(starts)


def _quotient(
    one: Callable, point: tuple, there: Tree, out: AbstractSpace, into: AbstractSpace, by: str
) -> jax.Array:
    t, x, u = point
    here = x if by == "x" else u
    a, b = one(t, x, u, there), one(t, x, u, here)
    length = into.norm(_tree.sub(there, here))
    # What rounding alone may make of two near points is no slope.
    eps = jnp.finfo(length.dtype).eps
    change = out.norm(_tree.sub(a, b)) - 64 * eps * (out.norm(a) + out.norm(b))
    return jnp.where(length > 0, change / jnp.where(length > 0, length, 1.0), 0.0)


def _norm(
    fn: Callable[[Tree], Tree], v: Tree, out: AbstractSpace, into: AbstractSpace
) -> jax.Array:
    """‖∂fn‖ at v: singular values, or for large arrays a few rounds of the power method."""
    size = sum(leaf.size for leaf in jtu.tree_leaves(v))
    value, push = jax.linearize(fn, v)
    if size <= _DENSE:
        flat, unravel = jax.flatten_util.ravel_pytree(v)
        roots = flat_roots(into, v)
        rows = jax.vmap(lambda e: push(unravel(e / roots)))(jnp.eye(size, dtype=flat.dtype))
        matrix = jax.vmap(lambda row: jax.flatten_util.ravel_pytree(row)[0])(rows)
        matrix = matrix * flat_roots(out, value)[None, :]
        square = matrix @ matrix.T
        return jnp.sqrt(jnp.linalg.norm(square, ord="fro") if size == 1 else _largest(square))
    pull = jax.linear_transpose(push, v)
    d = jtu.tree_map(jnp.ones_like, v)
    gain = jnp.zeros(())
    for _ in range(8):
        d = _tree.scale(1.0 / jnp.maximum(into.norm(d), 1e-300), d)
        image = push(d)
        gain = out.norm(image)
        (d,) = pull(jtu.tree_map(jnp.multiply, image, whole(out, image)))
        d = jtu.tree_map(jnp.divide, d, whole(into, d))
    return gain


def _largest(square: jax.Array) -> jax.Array:
    return jnp.maximum(jnp.linalg.eigvalsh(square)[-1], 1e-300)


def _bounds(region: Region) -> tuple[Any, Any]:
    is_slope = lambda v: isinstance(v, Slope)  # noqa: E731
    ends = (
        jtu.tree_map(lambda v, i=i: jnp.asarray(v[i]), tuple(region)[:3], is_leaf=is_slope)
        for i in (0, 1)
    )
    return next(ends), next(ends)


def _points(low: Any, high: Any, count: int, seed: int) -> Any:
    """Evenly drawn points of a box, its middle and ends among them."""
    rng = np.random.default_rng(seed)
    size = sum(leaf.size for leaf in jtu.tree_leaves(low))
    count = max(4, min(count, _ENTRIES // size))

    def draw(a: jax.Array, b: jax.Array) -> jax.Array:
        share = rng.random((count, *a.shape))
        share[0], share[1], share[2] = 0.0, 1.0, 0.5
        low, high = np.asarray(a), np.asarray(b)
        return jnp.asarray(low + share * (high - low), a.dtype)

    return jtu.tree_map(draw, low, high)
