"""The validity of constants: an interval of time, one value of `args`, and bounds on x and u."""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._captured import Reads
from .._tree import Tree
from ..spaces import AbstractSpace


class Domain(eqx.Module):
    """The set of times, parameters, states and responses for which constants hold.

    They hold for t0 ≤ t ≤ t1 (−∞ and ∞ if f, h and K do not depend on t), one value of `args`, and one
    problem with what its functions read from around them (`reads`; None: not known to matter).
    `x` and `u` are entrywise bounds (low, high); None means any x, and any u in P⁻¹K(t).
    """

    t0: float
    t1: float
    x: tuple[Tree, Tree] | None
    u: tuple[Tree, Tree] | None
    values: tuple[Any, ...]
    frame: tuple[Any, ...] = eqx.field(static=True)
    reads: Reads | None = eqx.field(static=True)

    def __init__(
        self,
        t0: float,
        t1: float,
        x: tuple[Tree, Tree] | None,
        u: tuple[Tree, Tree] | None,
        args: Any,
        reads: Reads | None = None,
    ):
        self.reads = reads
        self.t0, self.t1, self.x, self.u = t0, t1, x, u
        # Copies: an array of NumPy may be changed afterwards, and would still equal itself.
        values, self.frame = _numbers_and_rest(args)
        self.values = tuple(np.array(v) if isinstance(v, np.ndarray) else v for v in values)

    @property
    def is_unbounded(self) -> bool:
        """True if x and u are unrestricted."""
        return self.x is None and self.u is None

    def covers(self, t0: Any, t1: Any) -> bool:
        """Return whether a run from t0 to t1 lies in the interval of time; False for traced times."""
        if not _tree.is_concrete(t0, t1):
            return False
        margin = 1e-12 * max(abs(self.t0), abs(self.t1))
        return self.t0 - margin <= float(t0) and float(t1) <= self.t1 + margin

    def includes(self, x: tuple[Tree, Tree], u: tuple[Tree, Tree]) -> bool:
        """Return whether states and responses between these bounds (low, high) lie in the domain."""
        for values, ends in ((x, self.x), (u, self.u)):
            if ends is not None:
                leaves = zip(*map(jtu.tree_leaves, (*values, *ends)), strict=True)
                if not all((a >= low).all() and (b <= high).all() for a, b, low, high in leaves):
                    return False
        return True

    def has_args(self, args: Any, reads: Reads | None = None) -> bool:
        """Return whether `args`, and what the functions read, equal those of the constants; False for
        traced values."""
        if self.reads is not None and self.reads != reads:
            return False
        values, frame = _numbers_and_rest(args)
        if frame != self.frame or not _tree.is_concrete(values, self.values):
            return False
        # A quotient of integers is rounded.
        return all(
            jnp.result_type(a) == jnp.result_type(b) and np.array_equal(a, b)
            for a, b in zip(values, self.values, strict=True)
        )

    def contains(
        self,
        x: tuple[Tree, Tree],
        u: tuple[Tree, Tree],
        x_error: jax.Array,
        u_error: jax.Array,
        spaces: tuple[AbstractSpace, ...],
    ) -> jax.Array:
        """Return, for each saved time, whether the exact x and u lie in the domain up to that time.

        `x` and `u` are bounds (low, high) on the computed values since the saved time before, and
        `x_error` and `u_error` are bounds on the norms of their errors.
        """
        inside = jnp.ones(x_error.shape, bool)
        for values, error, ends, space in zip((x, u), (x_error, u_error), (self.x, self.u), spaces):
            if ends is not None:
                for least, most, low, high in _ranges(*values, error, ends, space):
                    within = (least >= low) & (most <= high)
                    inside = inside & jnp.all(within.reshape(len(inside), -1), axis=1)
        return jnp.cumsum(~inside) == 0

    def exit_at(
        self,
        k: int,
        x: tuple[Tree, Tree],
        u: tuple[Tree, Tree],
        x_error: jax.Array,
        u_error: jax.Array,
        spaces: tuple[AbstractSpace, ...],
    ) -> str:
        """Return which entry may leave the domain by the most before the k-th saved time, as text.

        The arguments are those of `contains`, with known values."""
        found = []
        data = zip("xu", (x, u), (x_error, u_error), (self.x, self.u), spaces)
        for name, values, error, ends, space in data:
            if ends is None:
                continue
            for place, ranges in enumerate(_ranges(*values, error, ends, space)):
                least, most, low, high = (np.asarray(v) for v in ranges)
                outside = np.maximum(low - least[k], most[k] - high).ravel()
                at = int(np.argmax(outside))
                computed = (np.ravel(jtu.tree_leaves(v)[place][k])[at] for v in values)
                text = (
                    f"{name}{_entry(values[0], place, at)} is computed within "
                    "[{:.6g}, {:.6g}] ".format(*computed)
                    + f"with an error of norm ≤ {float(error[k]):.3g}, and its limits are "
                    f"{low.ravel()[at]:.6g} and {high.ravel()[at]:.6g}"
                )
                found.append((outside[at], text))
        return max(found)[1]


def _numbers_and_rest(args: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return the numbers in args, and its structure with the other leaves."""
    leaves, structure = jtu.tree_flatten(args)
    leaves = [jax.random.key_data(leaf) if _tree.is_key(leaf) else leaf for leaf in leaves]
    numbers = tuple(leaf for leaf in leaves if eqx.is_array_like(leaf))
    others = tuple(None if eqx.is_array_like(leaf) else leaf for leaf in leaves)
    return numbers, (structure, others)


def _entry(rows: Tree, place: int, at: int) -> str:
    """Return the place of an entry of one leaf, such as [3], of a tree with one row a saved time."""
    path, leaf = jtu.tree_flatten_with_path(rows)[0][place]
    index = np.unravel_index(at, leaf.shape[1:])
    return jtu.keystr(path) + (f"[{', '.join(map(str, index))}]" if index else "")


def _ranges(
    lows: Tree, highs: Tree, bound: jax.Array, ends: tuple[Tree, Tree], space: AbstractSpace
) -> Iterator[tuple[jax.Array, ...]]:
    """Yield, for every leaf, the least and the largest possible values of its entries, a row a saved
    time, for computed values in [lows, highs] with errors of norm ≤ `bound`, and a row of its ends."""
    weights = jtu.tree_map(
        lambda leaf, w: np.broadcast_to(w, leaf.shape[1:]), lows, space.weights()
    )
    leaves = map(jtu.tree_leaves, (lows, highs, weights, *ends))
    for least, most, w, low, high in zip(*leaves, strict=True):
        reach = bound.reshape(-1, *(1,) * (least.ndim - 1)) / jnp.sqrt(w)[None]
        yield least - reach, most + reach, low[None], high[None]
