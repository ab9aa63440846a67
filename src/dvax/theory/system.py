"""The data of a problem as matrices: the derivatives of f and h over a region, P⁻¹ and A."""

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree

from .._tree import Tree
from ..problem import Problem
from ..programs.slope import Slope, SlopeEnclosure, TooLarge, interval
from ..programs.structure import independent
from ..sets._conditions import limits, row_data, rows
from ..sets._face import is_polyhedral
from .blocks import Block, block, identity
from .region import Region
from .weights import roots

_MAX_KEPT = 4096
"""Largest number of regions whose derivatives are kept."""


class Jacobians(NamedTuple):
    """∂f/∂x, ∂f/∂u, ∂h/∂x, ∂h/∂u over a region, in the norms of the spaces; None if too large for a
    matrix. `unknown`: the operations in f and in h that have no rule. `h`: the values of h."""

    f_x: Block | None
    f_u: Block | None
    h_x: Block | None
    h_u: Block | None
    unknown: dict[str, tuple[str, ...]]
    h: Tree | None


class System:
    """The data of a problem as matrices in the norms of its spaces.

    A, P and K belong to the parameter `args`; f and h as well, unless `varied`: then they take the
    parameter as an argument. `max_cuts`: the largest number of cuts of a region by branch and bound.
    """

    def __init__(
        self, problem: Problem, x0: Tree, args: Any, varied: bool = False, max_cuts: int = 40
    ):
        self.max_cuts = max_cuts
        self.problem, self.args = problem, args
        self._cache: dict[bytes, Jacobians] = {}
        self.x0, self.u0 = x0, problem.zero_control(x0)
        self.state, self.control = problem.spaces(x0)
        self._roots_x, self._roots_u = roots(self.state, x0), roots(self.control, self.u0)
        time = jnp.zeros(())
        self.varied, self.eta = varied, args if varied else ()
        self.f, self.h = (
            lambda t, x, u, eta=(), fn=fn: fn(t, x, u, eta if varied else args)
            for fn in (problem.f, problem.h)
        )
        self.likes = time, self.x0, self.u0, self.eta
        self._f, self._h = (SlopeEnclosure(fn, self.likes, (1, 2)) for fn in (self.f, self.h))
        P = problem.operator(args)
        self.spectrum = P.spectrum(self.control)
        self.growth = problem.generator(args).growth(self.state)
        self.P = self._of_linear(P.apply, self.control, self.u0)
        self.P_inv = self._of_linear(P.inverse, self.control, self.u0)
        self.A = self._of_linear(problem.generator(args).apply, self.state, self.x0)

    def at(self, region: Region) -> Jacobians:
        """Return the derivatives over this region, cached because all moduli use nearly the same
        pieces."""
        key = b"".join(end.tobytes() for v in region.leaves for end in v[:2])
        if key not in self._cache:
            if len(self._cache) >= _MAX_KEPT:
                self._cache.clear()
            self._cache[key] = self._at(region)
        return self._cache[key]

    def _at(self, region: Region) -> Jacobians:
        parts = len(jtu.tree_leaves(self.x0))
        blocks: list[Block | None] = []
        unknown: dict[str, tuple[str, ...]] = {}
        out: Tree | None = None
        for name, enclosure in (("f", self._f), ("h", self._h)):
            try:
                out, unknown[name] = enclosure(*region)
            except TooLarge:
                blocks += [None, None]
                out, unknown[name] = None, ()
                continue
            roots_out = self._roots_x if name == "f" else self._roots_u
            blocks.append(_block_or_none(out, 0, roots_out, self._roots_x))
            blocks.append(_block_or_none(out, parts, roots_out, self._roots_u))
        f_x, f_u, h_x, h_u = blocks
        return Jacobians(f_x, f_u, h_x, h_u, unknown, out)

    def frozen(self, h_u: Block) -> Block:
        """Return ∂F/∂y = (I − ∂h/∂u) P⁻¹ (eq:F_def)."""
        if self.P_inv is None:
            raise TooLarge
        return identity(h_u).plus(h_u, -1.0) @ self.P_inv

    def limits(self, time: Slope) -> tuple[Slope, ...]:
        """Return the limits of K(t): both ends of the intervals of a box, entry by entry, or the limits
        of the rows and their widths; nothing for another set."""
        return () if self._limits is None else self._limits(time).out

    @cached_property
    def rows(self) -> np.ndarray | None:
        """The rows of the linear conditions of a set that is no box, if they do not depend on t."""
        problem, args, like = self.problem, self.args, self.u0
        K = problem.set_at(jnp.zeros(()), args)
        if K.intervals(like) is not None or not is_polyhedral(K):
            return None
        is_fixed = independent(lambda t: row_data(problem.set_at(t, args)), jnp.zeros(()))
        return rows(K, like) if is_fixed else None

    @cached_property
    def _limits(self) -> SlopeEnclosure | None:
        time = jnp.zeros(())
        of_set = lambda t: limits_at(self.problem, self.args, self.rows, t, self.u0)  # noqa: E731
        return SlopeEnclosure(of_set, (time,), ()) if of_set(time) else None

    def _of_linear(self, apply: Callable[[Tree], Tree], space: Any, like: Tree) -> Block | None:
        """Return the matrix of a linear map, or None if it is too large or has operations without a
        rule."""
        anywhere = jtu.tree_map(
            lambda leaf: interval(np.full(leaf.shape, -np.inf), np.full(leaf.shape, np.inf)), like
        )
        try:
            out, unknown = SlopeEnclosure(apply, (like,), (0,))(anywhere)
            matrix = block(out, 0, roots(space, like), roots(space, like))
        except TooLarge:
            return None
        return matrix if not unknown and matrix.exact else None


def _block_or_none(*args: Any) -> Block | None:
    try:
        return block(*args)
    except TooLarge:
        return None


def limits_at(problem: Problem, args: Any, R: Any, t: Any, like: Tree) -> tuple[Any, ...]:
    """Return both ends of a box K(t), or the limits of the rows R and their widths, as vectors; nothing
    for another set."""
    K = problem.set_at(t, args)
    bounds = K.intervals(like)
    if bounds is not None:
        return tuple(ravel_pytree(end)[0] for end in bounds)
    return () if R is None else tuple(limits(K, R, like))
