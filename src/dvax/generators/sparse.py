"""Generators given by a sparse matrix."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from .faber import Ellipse, Range, smaller_ellipse
from .matrix_free import AbstractMatrixFree

_SCATTER_COST = 5
"""The cost of scattering one entry, relative to that of gathering one."""


class Sparse(AbstractMatrixFree):
    """A v = matrix @ v for a sparse matrix, such as those of finite elements or networks.

    For finite elements with a lumped mass m and a stiffness matrix S, use the matrix −S/m (row by row)
    and the space L2(m), and pass `weights=m`. Then A is self-adjoint with real spectrum, and e^{hA}
    costs about √(h‖A‖) products.

    Gershgorin's circles of the self-adjoint and the skew-adjoint part of A, in the inner product
    Σ wᵢ aᵢ bᵢ, enclose the numerical range; a second enclosure uses a symmetric scaling. The enclosure,
    and so the growth bound, is proved. The circles can be too large: they do not prove that a
    Laplacian decays. `within` then declares a smaller rectangle.

    **Arguments:**

    - `matrix`: of SciPy, or a `jax.experimental.sparse.BCOO`, whose `data` may be traced functions of
      `args`. Duplicate entries are added;
    - `weights`: of the inner product, one an unknown; 1 by default;
    - `within`: a `dvax.generators.Range` that contains the numerical range, in that inner product.

    **Raises:** `dvax.InputError` if the matrix is not square, not sparse or not of a floating type,
    or if the weights do not fit it.

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
        self.gathered, self.scattered = _storage(rows, cols, values, self.size)

    def apply(self, v: Tree) -> Tree:
        # Gather by columns of a padded table, each fused with its product. The remaining entries of
        # long rows are scattered.
        total = jnp.zeros_like(v)
        for indices, values in self.gathered:
            total = total + values * v[indices]
        if self.scattered is not None:
            rows, cols, values = self.scattered
            total = total.at[rows].add(values * v[cols], indices_are_sorted=True)
        return total

    def numerical_range(self) -> Range:
        """Return the enclosure from Gershgorin's circles, or `within`."""
        return self.range


class Triplets(NamedTuple):
    """The entries of a square matrix: concrete rows and columns, values, and the size."""

    rows: np.ndarray
    cols: np.ndarray
    values: Any
    size: int


def triplets(matrix: Any, name: str) -> Triplets:
    """Return the entries of a sparse matrix; `name` is its name in error messages."""
    if isinstance(matrix, Triplets):
        return matrix
    shape = tuple(np.shape(matrix))
    if hasattr(matrix, "tocsr"):
        coo = matrix.tocsr().tocoo()
        rows, cols, values = coo.row, coo.col, coo.data
    elif hasattr(matrix, "indices") and hasattr(matrix, "data") and np.ndim(matrix.indices) == 2:
        if not _tree.is_concrete(matrix.indices):
            raise input_error(
                name,
                "traced indices",
                "the sparsity pattern must be concrete; only the values may depend on args",
                "Compute the indices outside of A",
            )
        rows, cols = np.asarray(matrix.indices).T
        values = matrix.data
    else:
        raise input_error(
            name,
            f"{type(matrix).__name__} of shape {shape}",
            "it must be a sparse matrix of SciPy, or a jax.experimental.sparse.BCOO",
            "Use dvax.generators.Dense for an array, or convert it: scipy.sparse.csr_array(...)",
        )
    if len(shape) != 2 or shape[0] != shape[1]:
        raise input_error(
            name,
            f"shape {shape}",
            "a generator maps the state space to itself, so its matrix must be square",
            "Pass a square matrix",
        )
    values = _tree.as_float(values, name)
    _tree.require(
        lambda: np.isfinite(np.asarray(values)).all(), name, values,
        "every entry must be finite", "Correct the assembly of the matrix",
    )  # fmt: skip
    return Triplets(np.asarray(rows, np.int64), np.asarray(cols, np.int64), values, shape[0])


def _check_weights(weights: jax.Array, size: int) -> None:
    name = "dvax.generators.Sparse(weights)"
    if weights.shape not in ((), (size,)):
        raise input_error(
            name,
            f"shape {weights.shape}",
            f"it must be one number, or one for each of the {size} unknowns",
            "Give the diagonal of the lumped mass matrix",
        )
    _tree.require(
        lambda: bool(np.all(np.asarray(weights) > 0)), name, weights,
        "the weights of an inner product must be positive", "Correct those that are not",
    )  # fmt: skip


def _circles(rows: np.ndarray, cols: np.ndarray, values: Any, w: Any) -> Range:
    """Return the enclosure of the numerical range by Gershgorin's circles."""
    n = w.shape[0]
    keys, position = np.unique(np.r_[rows * n + cols, cols * n + rows], return_inverse=True)
    i, j = keys // n, keys % n
    # Every enclosure yields the same series, so its derivative is irrelevant (and may not exist).
    values, w = _tree.host(lax.stop_gradient((values, w)))
    direct, transposed = np.split(position, 2)
    a = _sums(direct, values, len(keys))
    adjoint = _sums(transposed, values * w[rows] / w[cols], len(keys))
    lib = _tree.array_module(values, w)
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
    best = Ellipse(*map(jnp.asarray, smaller_ellipse(*ellipses)))
    return Range(*map(jnp.asarray, sides), ellipse=best, proved=True)


def _hull(i: np.ndarray, centre: Any, even: Any, odd: Any) -> tuple[Any, Ellipse]:
    """Return (low, high, height) of a rectangle, and an ellipse, that contain the numerical range.

    The self-adjoint part of e^{−iθ}A has Gershgorin discs of the radii
    Σⱼ |cos θ·evenᵢⱼ + i sin θ·oddᵢⱼ|, by Cauchy's inequality at most

        √(Σⱼpⱼ Σⱼ(cos²θ evenᵢⱼ² + sin²θ oddᵢⱼ²)/pⱼ),      pⱼ = evenᵢⱼ/Σeven + oddᵢⱼ/Σodd,

    which is the support function of an ellipse. It is sharp if odd/even is constant along the row
    (constant coefficients), and at most √2 too large. Ellipses (aᵢ, bᵢ) with centres at the distances
    δᵢ from a common centre lie in one with a ≥ δᵢ + aᵢ and b² ≥ (1 + δᵢ/aᵢ)bᵢ², by the same inequality.
    """
    n, lib = len(centre), _tree.array_module(centre, even, odd)

    def positive(v: Any) -> Any:
        return lib.where(v > 0, v, 1.0)

    H, N = _sums(i, even, n), _sums(i, odd, n)
    p = even / positive(H)[i] + odd / positive(N)[i]
    total = _sums(i, p, n)
    a, b = (lib.sqrt(total * _sums(i, part**2 / positive(p), n)) for part in (even, odd))
    low, high = lib.min(centre - a), lib.max(centre + a)
    middle = (low + high) / 2
    distance = lib.abs(centre - middle)
    height = lib.max(
        lib.where(b > 0, b * lib.sqrt(1 + lib.where(a > 0, distance / positive(a), 0.0)), 0.0)
    )
    # A row without an even part has a = 0, so its ellipse is a segment. It lies in the ellipse with
    # both half-axes multiplied by √2.
    degenerate = lib.any((a == 0) & (b > 0) & (distance > 0))
    factor = lib.where(degenerate, np.sqrt(2.0), 1.0)
    ellipse = Ellipse(middle, factor * (high - low) / 2, factor * height)
    return (lib.min(centre - H), lib.max(centre + H), lib.max(N)), ellipse


def _sums(index: np.ndarray, values: Any, count: int) -> Any:
    """Return the sums of the values that have the same index."""
    if _tree.is_concrete(values):
        return np.bincount(index, values, count).astype(values.dtype)
    return jnp.zeros(count, values.dtype).at[index].add(values)


def _storage(rows: np.ndarray, cols: np.ndarray, values: Any, n: int) -> tuple[Any, Any]:
    """Return (a table of the first entries of each row, the remaining entries).

    The width of the table minimises the cost of a product.
    """
    order = np.argsort(rows, kind="stable")
    rows, cols = rows[order], cols[order]
    lengths = np.bincount(rows, minlength=n)
    slot = np.arange(len(rows)) - (np.cumsum(lengths) - lengths)[rows]
    longer = np.r_[np.cumsum(np.bincount(lengths)[::-1])[::-1][1:], 0]  # rows longer than k
    beyond = np.r_[np.cumsum(longer[::-1])[::-1], 0]  # entries outside a table of width k
    widths = np.arange(len(beyond))
    width = int(np.argmin(n * widths + _SCATTER_COST * beyond))
    columns = []
    for k in range(width):
        in_column = slot == k
        indices = np.arange(n)
        indices[rows[in_column]] = cols[in_column]
        column = jnp.zeros(n, values.dtype).at[rows[in_column]].set(values[order[in_column]])
        columns.append((jnp.asarray(indices, jnp.int32), column))
    remaining = slot >= width
    if not remaining.any():
        return tuple(columns), None
    index = (jnp.asarray(part[remaining], jnp.int32) for part in (rows, cols))
    return tuple(columns), (*index, values[order[remaining]])
