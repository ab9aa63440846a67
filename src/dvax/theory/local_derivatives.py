"""Derivatives of f and h on many short intervals of time, from one enclosure of their slopes.

Interval arithmetic on every interval of time would take long. The derivatives J have slopes of their
own, which are enclosed once over a region. For a box of half widths r around c inside the region

    |J(z) − J(c)| ≤ Λ r   entry by entry,  Λ a bound on |∂J|,

so that J is evaluated at the centers alone, for all boxes in one compiled call. The same holds for the
values of h and for the ends of a box K(t).
"""

import itertools
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree

from .. import _tree
from .._tree import Tree
from ..problem import Problem
from ..programs.derivatives_of_operations import of_operations
from ..programs.slope import Slope, SlopeEnclosure, TooLarge, columns, interval
from .blocks import Block, as_one_matrix
from .faces import Range
from .projection_speed import slopes
from .region import Region
from .system import System, limits_at
from .weights import roots

MAX_UNKNOWNS = 40
"""Largest number of unknowns of x and u together: the slopes of J have their cube as entries."""

_ROUNDINGS = 500.0
"""Relative rounding errors of an entry of J, as a multiple of the unit roundoff."""


class Derivatives(NamedTuple):
    """∂f/∂x, ∂f/∂u, ∂h/∂x and ∂h/∂u in the norms of the spaces, as stacks with one matrix for each box;
    the values there of u, of h, and of the `System.limits` of K(t). u may be outside K: its bounds are
    rounded, and must not hide that it is at one of them."""

    f_x: Block
    f_u: Block
    h_x: Block
    h_u: Block
    u: Range
    h: Range
    limits: tuple[Range, ...]


def of_region(system: System, region: Region, wide: Range | None = None) -> Derivatives | None:
    """Return the derivatives over a region, as stacks of one matrix, or None if one is too large.
    `wide`: the box of u before the bounds of K cut it."""
    J = system.at(region)
    blocks = J.f_x, J.f_u, J.h_x, J.h_u
    known = [b for b in blocks if b is not None]
    if len(known) < len(blocks) or J.h is None:
        return None
    try:
        f_x, f_u, h_x, h_u = map(as_one_matrix, known)
    except TooLarge:
        return None
    limits = tuple(Range(b.low[None], b.high[None]) for b in system.limits(region.t))
    return Derivatives(f_x, f_u, h_x, h_u, wide or _range(region.u), _range(J.h), limits)


class LocalDerivatives:
    """The derivatives of a system on boxes inside a region."""

    def __init__(self, system: System):
        self.system = system
        self.likes = jtu.tree_map(
            lambda v: jnp.zeros(jnp.shape(v), jnp.result_type(float)), (system.x0, system.u0)
        )
        self.n, self.k = (
            sum(map(np.size, jtu.tree_leaves(like))) for like in (system.x0, system.u0)
        )
        self.root_x = np.concatenate(roots(system.state, system.x0))
        self.root_u = np.concatenate(roots(system.control, system.u0))

    @property
    def is_known(self) -> bool:
        """Whether x and u are small enough, and their functions have derivatives in forward mode."""
        return self.n + self.k <= MAX_UNKNOWNS and self._enclosure is not None

    def at(
        self,
        region: Region,
        t: Range,
        x: Range,
        u: Range,
        capacity: int = 0,
        wide: Range | None = None,
    ) -> Derivatives | None:
        """Return the derivatives on boxes, whose bounds have a row each, inside the region; None if
        they are not known. For all numbers of boxes up to the `capacity` one program is compiled.
        `wide`: the boxes of u before the bounds of K cut them."""
        if self._enclosure is None:
            return None
        try:
            slopes_of = self._enclosure(region.t, *(_flat(tree) for tree in (region.x, region.u)))
        except TooLarge:
            return None
        boxes = [
            Range(v.low.reshape(len(v.low), -1), v.high.reshape(len(v.low), -1)) for v in (t, x, u)
        ]
        # In the precision of the evaluation, which may be single.
        dtype = jnp.result_type(float)
        centers = [(0.5 * (v.low + v.high)).astype(dtype).astype(float) for v in boxes]
        halves = [
            np.maximum(np.maximum(v.high - c, c - v.low), 0.0)
            for v, c in zip(boxes, centers, strict=True)
        ]
        count = len(centers[0])
        more = max(0, capacity - count)
        time, *others = (np.pad(c, ((0, more), (0, 0)), "edge") for c in centers)
        values = _values(
            self.system.problem, _tree.as_arrays(self.system.args), self.system.rows,
            (time[:, 0], *others), self.likes,
        )  # fmt: skip
        found = []
        for value, slope in zip(values, slopes_of.out, strict=True):
            center = np.asarray(value, float)[:count]
            rounding = _ROUNDINGS * float(jnp.finfo(value.dtype).eps)
            radius = np.where(np.isfinite(center), rounding * np.abs(center), 0.0)
            for k, part in slope.parts.items():
                full = columns(part, 1)
                size = (np.abs(full.center) + full.radius).reshape(full.center.shape[0], -1)
                with np.errstate(invalid="ignore"):
                    moved = np.where(size == 0.0, 0.0, halves[k][:, :, None] * size).sum(axis=1)
                radius = radius + moved.reshape(center.shape)
            found.append((center, radius))
        J, (h, *limits) = found[:4], (Range(c - r, c + r) for c, r in found[4:])
        f_x, f_u, h_x, h_u = (
            Block(center * (out[:, None] / into), radius * (out[:, None] / into))
            for (center, radius), (out, into) in zip(
                J, itertools.product((self.root_x, self.root_u), repeat=2), strict=True
            )
        )
        return Derivatives(f_x, f_u, h_x, h_u, wide or boxes[2], h, tuple(limits))

    @cached_property
    def _enclosure(self) -> SlopeEnclosure | None:
        system = self.system
        flat = [jnp.zeros(size) for size in (self.n, self.k)]
        try:
            return SlopeEnclosure(
                lambda *point: _evaluated(system.problem, system.args, system.rows, point, self.likes),
                (jnp.zeros(()), *flat), (0, 1, 2),
            )  # fmt: skip
        except (NotImplementedError, TypeError, ValueError):
            return None  # without derivatives, or those in forward mode


def _evaluated(
    problem: Problem, args: Any, R: Any, point: tuple[Any, ...], likes: Any
) -> tuple[Any, ...]:
    """Return the derivatives of f and h at a point as matrices, the value of h, and the limits of K."""
    t, x, u = point
    of_x, of_u = (ravel_pytree(like)[1] for like in likes)

    def both(x: Any, u: Any) -> Any:
        f, h = (fn(t, of_x(x), of_u(u), args) for fn in (problem.f, problem.h))
        return (ravel_pytree(f)[0], ravel_pytree(h)[0]), ravel_pytree(h)[0]

    plain = of_operations(both, x, u)
    ((f_x, f_u), (h_x, h_u)), h = jax.jacfwd(plain, argnums=(0, 1), has_aux=True)(x, u)
    return f_x, f_u, h_x, h_u, h, *limits_at(problem, args, R, t, likes[1])


@eqx.filter_jit
def _values(
    problem: Problem, args: Any, R: Any, points: tuple[Any, ...], likes: Any
) -> tuple[Any, ...]:
    """Return `_evaluated` for stacks of times, states and responses."""
    return jax.vmap(lambda point: _evaluated(problem, args, R, point, likes))(points)


def _flat(tree: Tree) -> Slope:
    """Return a tree of intervals as one vector of them."""
    found = slopes(tree)
    low, high = (
        np.concatenate([getattr(v, end).ravel() for v in found]) for end in ("low", "high")
    )
    return interval(low, high)


def _range(tree: Tree) -> Range:
    """Return a tree of intervals as a stack of one row."""
    flat = _flat(tree)
    return Range(flat.low[None], flat.high[None])
