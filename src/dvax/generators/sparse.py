"""A given as a sparse matrix."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from .faber import Ellipse, Range, smaller
from .matrix_free import AbstractMatrixFree

_SCATTER = 5
"""What an entry that is scattered costs, in entries that are gathered."""


class Sparse(AbstractMatrixFree):
    """A v = matrix @ v for a sparse matrix: finite elements, networks, any mesh.

    Finite elements with a lumped mass m and a stiffness matrix S have the matrix −S/m (row by row)
    and live in the space L2(m): give `weights=m` as well. Then A is self-adjoint, its spectrum real,
    and e^{hA} costs the root of h‖A‖ products.

    The numerical range is enclosed by Gershgorin's circles of the self-adjoint and the skew part of A
    in the inner product Σ wᵢ aᵢ bᵢ, as they are and after a symmetric scaling: proved, and so is the
    growth bound. Where these are too wide (they never see that a Laplacian decays), `within` declares a
    better rectangle.

    **Arguments:**

    - `matrix`: of SciPy, or a `jax.experimental.sparse.BCOO`, whose `data` may be traced: a function
      of `args`. Entries that are stored twice add up;
    - `weights`: of the inner product, one an unknown; 1 by default;
    - `within`: a `dvax.generators.Range` that contains the numerical range, in that inner product.

    **Raises:** `dvax.InputError` where the matrix is not square, not sparse, not of a floating type,
    or where the weights do not fit it.

    ```python
    >>> import dvax, jax.numpy as jnp, scipy.sparse
    >>> n = 50
    >>> S = scipy.sparse.diags([1.0, -2.0, 1.0], [-1, 0, 1], shape=(n, n)) * (n + 1) ** 2
    >>> A = dvax.generators.Sparse(S)
    >>> s = jnp.arange(1, n + 1) / (n + 1)
    >>> warm = A.semigroup(0.1, jnp.sin(jnp.pi * s))      # decays as e^{−π²t}, nearly
    >>> print(f"{float(warm.max()):.3f}")
    0.373

    ```
    """

    gathered: tuple[tuple[jax.Array, jax.Array], ...]
    scattered: tuple[jax.Array, jax.Array, jax.Array] | None
    range: Range
    size: int = eqx.field(static=True)

    def __init__(self, matrix: Any, weights: Any = 1.0, within: Range | None = None):
        rows, cols, values, self.size = triplets(matrix, "dvax.generators.Sparse(matrix)")
        weights = _tree.as_array(weights, "dvax.generators.Sparse(weights)")
        _check_weights(weights, self.size)
        w = jnp.broadcast_to(weights, (self.size,)).astype(values.dtype)
        self.range = _circles(rows, cols, values, w)._replace(weights=weights)
        if within is not None:
            self.range = within._replace(weights=weights, proved=False)
        self.gathered, self.scattered = _laid_out(rows, cols, values, self.size)

    def apply(self, v: Tree) -> Tree:
        # Column after column of a padded table: that is one pass of gathers, and each is fused with
        # its product. Long rows are finished entry by entry.
        total = jnp.zeros_like(v)
        for places, values in self.gathered:
            total = total + values * v[places]
        if self.scattered is not None:
            rows, cols, values = self.scattered
            total = total.at[rows].add(values * v[cols], indices_are_sorted=True)
        return total

    def numerical_range(self) -> Range:
        """What the circles, or `within`, enclose."""
        return self.range


class Triplets(NamedTuple):
    """The entries of a square matrix: rows and columns, never traced, values, and the size."""

    rows: np.ndarray
    cols: np.ndarray
    values: Any
    size: int


def triplets(matrix: Any, name: str) -> Triplets:
    """The entries of a sparse matrix that errors call `name`."""
    if isinstance(matrix, Triplets):
        return matrix
    shape = tuple(np.shape(matrix))
    if hasattr(matrix, "tocsr"):
        found = matrix.tocsr().tocoo()
        rows, cols, values = found.row, found.col, found.data
    elif hasattr(matrix, "indices") and hasattr(matrix, "data") and np.ndim(matrix.indices) == 2:
        if not _tree.is_concrete(matrix.indices):
            raise InputError(
                InputProblem(
                    name,
                    "indices that are traced",
                    "where the entries stand is looked at once, before anything runs; their values "
                    "alone may depend on args",
                    "Make the indices outside of A, once",
                )
            )
        rows, cols = np.asarray(matrix.indices).T
        values = matrix.data
    else:
        raise InputError(
            InputProblem(
                name,
                f"{type(matrix).__name__} of shape {shape}",
                "it must be a sparse matrix of SciPy, or a jax.experimental.sparse.BCOO",
                "Use dvax.generators.Dense for an array, or wrap it: scipy.sparse.csr_array(...)",
            )
        )
    if len(shape) != 2 or shape[0] != shape[1]:
        raise InputError(
            InputProblem(
                name,
                f"shape {shape}",
                "a generator maps the state space to itself, so its matrix is square",
                "Mend its shape",
            )
        )
    values = _tree.as_float(values, name)
    _tree.require(
        lambda: np.isfinite(np.asarray(values)).all(), name, values,
        "every entry must be finite", "Mend the assembly of the matrix",
    )  # fmt: skip
    return Triplets(np.asarray(rows, np.int64), np.asarray(cols, np.int64), values, shape[0])


def _check_weights(weights: jax.Array, size: int) -> None:
    name = "dvax.generators.Sparse(weights)"
    if weights.shape not in ((), (size,)):
        raise InputError(
            InputProblem(
                name,
                f"shape {weights.shape}",
                f"one number, or one for each of the {size} unknowns",
                "Give the diagonal of the lumped mass matrix",
            )
        )
    _tree.require(
        lambda: bool(np.all(np.asarray(weights) > 0)), name, weights,
        "an inner product has positive weights", "Mend those that are not",
    )  # fmt: skip


def _circles(rows: np.ndarray, cols: np.ndarray, values: Any, w: Any) -> Range:
    """Gershgorin's circles of the self-adjoint part of A, and a bound on the norm of the skew one."""
    n = w.shape[0]
    keys, place = np.unique(np.r_[rows * n + cols, cols * n + rows], return_inverse=True)
    i, j = keys // n, keys % n
    # Any enclosure gives the same series: its own derivative does not matter, and may not exist.
    values, w = _tree.host(lax.stop_gradient((values, w)))
    there, back = np.split(place, 2)
    a = _sums(there, values, len(keys))
    adjoint = _sums(back, values * w[rows] / w[cols], len(keys))
    lib = _tree.library(values, w)
    root = lib.sqrt(w)
    centre = _sums(i, lib.where(i == j, a, 0.0), n)
    even, odd = (lib.where(i == j, 0.0, part / 2) for part in (a + adjoint, a - adjoint))
    rectangles, ellipses = zip(
        *(
            _hull(i, centre, lib.abs(scaling * even), lib.abs(scaling * odd))
            for scaling in (1.0, root[i] / root[j])
        ),
        strict=True,
    )
    low, high, height = zip(*rectangles, strict=True)
    sides = lib.maximum(*low), lib.minimum(*high), lib.minimum(*height)
    best = Ellipse(*map(jnp.asarray, smaller(*ellipses)))
    return Range(*map(jnp.asarray, sides), ellipse=best, proved=True)


def _hull(i: np.ndarray, centre: Any, even: Any, odd: Any) -> tuple[Any, Ellipse]:
    """(low, high, height) of a rectangle, and an ellipse, that contain the discs of all rows i, turned
    to any angle θ.

    The part of A that is self-adjoint after a turn by −θ has the discs with the radii
    Σⱼ |cos θ·evenᵢⱼ + i sin θ·oddᵢⱼ|, by Cauchy's inequality at most

        √(Σⱼpⱼ Σⱼ(cos²θ evenᵢⱼ² + sin²θ oddᵢⱼ²)/pⱼ),      pⱼ = evenᵢⱼ/Σeven + oddᵢⱼ/Σodd,

    the support function of an ellipse: no larger than it must be where odd/even is the same all along
    the row (constant coefficients), and √2 too large at worst. Ellipses (aᵢ, bᵢ) whose centres lie δᵢ
    from that of all lie in one with a ≥ δᵢ + aᵢ and b² ≥ (1 + δᵢ/aᵢ)bᵢ², by the same inequality.
    """
    n, lib = len(centre), _tree.library(centre, even, odd)
    positive = lambda v: lib.where(v > 0, v, 1.0)  # noqa: E731
    H, N = _sums(i, even, n), _sums(i, odd, n)
    p = even / positive(H)[i] + odd / positive(N)[i]
    total = _sums(i, p, n)
    a, b = (lib.sqrt(total * _sums(i, part**2 / positive(p), n)) for part in (even, odd))
    low, high = lib.min(centre - a), lib.max(centre + a)
    middle = (low + high) / 2
    apart = lib.abs(centre - middle)
    tall = lib.max(
        lib.where(b > 0, b * lib.sqrt(1 + lib.where(a > 0, apart / positive(a), 0.0)), 0.0)
    )
    # A row without an even part has a = 0, and its ellipse is a segment: it fits into one with twice
    # the square of either axis.
    flat = lib.any((a == 0) & (b > 0) & (apart > 0))
    more = lib.where(flat, np.sqrt(2.0), 1.0)
    ellipse = Ellipse(middle, more * (high - low) / 2, more * tall)
    return (lib.min(centre - H), lib.max(centre + H), lib.max(N)), ellipse


def _sums(index: np.ndarray, values: Any, count: int) -> Any:
    """Of the values that share an index."""
    if _tree.is_concrete(values):
        return np.bincount(index, values, count).astype(values.dtype)
    return jnp.zeros(count, values.dtype).at[index].add(values)


def _laid_out(rows: np.ndarray, cols: np.ndarray, values: Any, n: int) -> tuple[Any, Any]:
    """A table of the first entries of each row, and the rest: as wide as makes a product cheapest."""
    order = np.argsort(rows, kind="stable")
    rows, cols = rows[order], cols[order]
    lengths = np.bincount(rows, minlength=n)
    slot = np.arange(len(rows)) - (np.cumsum(lengths) - lengths)[rows]
    longer = np.r_[np.cumsum(np.bincount(lengths)[::-1])[::-1][1:], 0]  # rows longer than k
    beyond = np.r_[np.cumsum(longer[::-1])[::-1], 0]  # entries outside a table of width k
    widths = np.arange(len(beyond))
    width = int(np.argmin(n * widths + _SCATTER * beyond))
    columns = []
    for k in range(width):
        here = slot == k
        places = np.arange(n)
        places[rows[here]] = cols[here]
        column = jnp.zeros(n, values.dtype).at[rows[here]].set(values[order[here]])
        columns.append((jnp.asarray(places, jnp.int32), column))
    rest = slot >= width
    if not rest.any():
        return tuple(columns), None
    index = (jnp.asarray(part[rest], jnp.int32) for part in (rows, cols))
    return tuple(columns), (*index, values[order[rest]])
