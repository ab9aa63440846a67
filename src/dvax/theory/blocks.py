"""Derivatives as matrices in the norms of their spaces; for pointwise laws, a stack of small ones."""

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax.tree_util as jtu
import numpy as np

from .._tree import Tree
from ..programs.slope import MAX_ENTRIES, Part, Slope, TooLarge, Values, columns, is_slope

_MAX_DENSE_SIZE = 2_000
"""Largest number of rows or columns for which singular values are computed."""

_MAX_VERTEX_ENTRIES = 200_000
"""Largest number of entries of all vertices of interval matrices whose eigenvalues are computed."""


class Block(NamedTuple):
    """W_q^{1/2} (∂q/∂v) W_v^{-1/2} with the weights W of the spaces, as `center` ± `radius`.

    Its Euclidean norm is the operator norm between the spaces, and its transpose is the adjoint. It is
    a stack of matrices of shape (points, rows, columns): a single matrix, or one per point if entries
    at different points are not coupled.
    """

    center: Values
    radius: Values

    @property
    def T(self) -> "Block":
        return Block(self.center.swapaxes(1, 2), self.radius.swapaxes(1, 2))

    @property
    def exact(self) -> bool:
        """True if every radius is 0."""
        return not self.radius.any()

    def __matmul__(self, other: "Block") -> "Block":
        a, b = with_equal_counts(self, other)
        radius = _dot(np.abs(a.center), b.radius) + _dot(a.radius, np.abs(b.center) + b.radius)
        return Block(a.center @ b.center, radius)

    def plus(self, other: "Block", sign: float = 1.0) -> "Block":
        a, b = with_equal_counts(self, other)
        return Block(a.center + sign * b.center, a.radius + b.radius)

    def times(self, factor: Values) -> "Block":
        return Block(factor * self.center, np.abs(factor) * self.radius)

    def norm(self) -> float:
        """Return sup ‖·‖ over the enclosed matrices, with ‖Δ‖₂ ≤ ‖|Δ|‖₂ ≤ ‖radius‖₂."""
        return float(np.max(norms(self.center) + self.radius_norms(), initial=0.0))

    def radius_norms(self) -> Values:
        """Return ‖radius‖ of every matrix."""
        return norms(self.radius)

    def smallest_quotient(self) -> float:
        """Return inf ⟨Jd, d⟩/‖d‖² over the enclosed matrices: the least smallest eigenvalue of the
        symmetric parts, or a lower bound of it for large ones."""
        sym, radius = (0.5 * (v + v.swapaxes(1, 2)) for v in (self.center, self.radius))
        known = np.isfinite(radius).all(axis=(1, 2))
        if not known.all():
            return -np.inf
        if not radius.any():
            found = eigenvalues(sym)[:, 0]
        elif 2 ** (sym.shape[1] - 1) * sym.size <= _MAX_VERTEX_ENTRIES:
            found = np.min([eigenvalues(v)[:, 0] for v in _vertices(sym, radius)], axis=0)
        else:
            found = np.max(
                [eigenvalues(sym - diagonal(e))[:, 0] for e in dominating(radius)], axis=0
            )
        return float(np.min(found, initial=np.inf))


def identity(like: Block) -> Block:
    """Return the identity as a stack shaped like `like`."""
    points, rows, _ = like.center.shape
    eye = np.broadcast_to(np.eye(rows), (points, rows, rows))
    return Block(eye, np.zeros_like(eye))


def with_equal_counts(a: Block, b: Block) -> tuple[Block, Block]:
    """Return two stacks with the same number of matrices."""
    if len(a.center) == len(b.center):
        return a, b
    if len(a.center) == 1 or len(b.center) == 1:
        return as_one_matrix(a), as_one_matrix(b)
    raise TooLarge


def as_one_matrix(a: Block) -> Block:
    """Return the stack as a single matrix; entry i of part k is row k·points + i."""
    points, rows, cols = a.center.shape
    if points == 1:
        return a
    if points * rows > _MAX_DENSE_SIZE or points * cols > _MAX_DENSE_SIZE:
        raise TooLarge

    def large(stack: Values) -> Values:
        out = np.zeros((rows, points, cols, points))
        index = np.arange(points)
        out[:, index, :, index] = stack
        return out.reshape(1, rows * points, cols * points)

    return Block(large(a.center), large(a.radius))


def block(out: Tree, first: int, roots_out: list[Values], roots_in: list[Values]) -> Block:
    """Return ∂q/∂v for a tree of slopes q.

    The parts of the slopes from index `first` on belong to the leaves of the element v. `roots_out` and
    `roots_in` are the square roots of the weights of both spaces.

    **Raises:** `TooLarge`.
    """
    slopes: list[Slope] = jtu.tree_leaves(out, is_leaf=is_slope)
    rows = [[s.parts.get(first + j) for j in range(len(roots_in))] for s in slopes]
    if _pointwise(rows, roots_out, roots_in):
        return _stacked(rows, roots_out, roots_in)
    sizes_out, sizes_in = [r.size for r in roots_out], [r.size for r in roots_in]
    if (
        max(sum(sizes_out), sum(sizes_in)) > _MAX_DENSE_SIZE
        or sum(sizes_out) * sum(sizes_in) > MAX_ENTRIES
    ):
        raise TooLarge

    def assemble(pick: Callable[[Part], Values]) -> Values:
        grid = []
        for row, out in zip(rows, roots_out, strict=True):
            grid_row = []
            for part, into in zip(row, roots_in, strict=True):
                if part is None:
                    grid_row.append(np.zeros((out.size, into.size)))
                    continue
                full = pick(columns(part, into.size)).reshape(into.size, -1).T
                grid_row.append(_scaled(full, out[:, None], into[None, :]))
            grid.append(grid_row)
        return np.block(grid)[None]

    return Block(assemble(lambda part: part.center), assemble(lambda part: part.radius))


def _pointwise(rows: list[list[Part | None]], *roots: list[Values]) -> bool:
    sizes = {root.size for group in roots for root in group}
    diagonal = all(part is None or not part.full for row in rows for part in row)
    return diagonal and len(sizes) == 1


def _stacked(
    rows: list[list[Part | None]], roots_out: list[Values], roots_in: list[Values]
) -> Block:
    points = roots_out[0].size
    center, radius = (np.zeros((points, len(rows), len(roots_in))) for _ in range(2))
    for i, row in enumerate(rows):
        for j, part in enumerate(row):
            if part is not None:
                for stack, values in ((center, part.center), (radius, part.radius)):
                    stack[:, i, j] = _scaled(values.ravel(), roots_out[i], roots_in[j])
    return Block(center, radius)


def dominating(radius: Values) -> tuple[Values, ...]:
    """Return diagonals e with ⟨Δd, d⟩ ≤ Σᵢ eᵢ dᵢ² for every Δ with |Δ| ≤ `radius`, which is symmetric:
    the norm of the radius; its diagonal and the norm of the rest; the sums of its rows."""
    entries = np.diagonal(radius, axis1=1, axis2=2)
    rest = radius - diagonal(entries)
    return (
        np.broadcast_to(norms(radius)[:, None], entries.shape),
        entries + norms(rest)[:, None],
        radius.sum(axis=2),
    )


def diagonal(entries: Values) -> Values:
    """Return the diagonal matrices with these entries."""
    return entries[:, :, None] * np.eye(entries.shape[1])


def _vertices(center: Values, radius: Values) -> Iterator[Values]:
    """Return the matrices among which is, for symmetric `center` ± `radius`, the one of least smallest
    eigenvalue: with the eigenvector d the term −rᵢⱼ|dᵢdⱼ| is taken with the signs z of d (Hertz, IEEE
    Trans. Autom. Control 37 (1992))."""
    for signs in itertools.product((1.0, -1.0), repeat=center.shape[1] - 1):
        z = np.array([1.0, *signs])
        yield center - z[:, None] * radius * z


def _scaled(values: Values, out: Values, into: Values) -> Values:
    """Return values · out / into, without rounding if the weights are equal."""
    return values * np.where(out == into, 1.0, out / into)


def _dot(a: Values, b: Values) -> Values:
    """Return a @ b for nonnegative matrices, with 0 · ∞ = 0."""
    if np.isfinite(a).all() and np.isfinite(b).all():
        return a @ b
    infinite = np.isinf(a) * 1.0 @ (b > 0) + (a > 0) * 1.0 @ np.isinf(b)
    finite = np.where(np.isinf(a), 0.0, a) @ np.where(np.isinf(b), 0.0, b)
    return np.where(infinite > 0, np.inf, finite)


def norms(stack: Values) -> Values:
    """Return ‖·‖₂ of every matrix."""
    if stack.shape[1:] == (1, 1):
        return np.abs(stack[:, 0, 0])
    infinite: Values = np.any(np.isinf(stack) | np.isnan(stack), axis=(1, 2))
    if not stack.any():
        return np.zeros(len(stack))
    finite = np.where(infinite[:, None, None], 0.0, stack)
    return np.where(infinite, np.inf, np.linalg.norm(finite, 2, axis=(1, 2)))


def eigenvalues(symmetric: Values) -> Values:
    """Return the eigenvalues of every matrix in ascending order."""
    return symmetric[:, 0, :1] if symmetric.shape[1:] == (1, 1) else np.linalg.eigvalsh(symmetric)
