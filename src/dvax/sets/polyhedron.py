"""Polyhedra: linear inequalities and equations."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .. import _tree
from .._small_matrices import as_pseudoinverse, pseudoinverse, times
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from . import _dual_active_set as dual
from ._moving import jvp_of_moving
from ._weights import inverse_weights
from .abstract import AbstractSet
from .affine import (
    check_row_shapes,
    checked_rows,
    has_solution,
    normalise_rows,
    normalised_conditions,
)

_LISTED = 8
"""Most rows that a message lists."""

_ROUNDINGS = 8.0
"""Violation of the equations, in roundings of the point, that a projection leaves uncorrected."""


class Polyhedron(AbstractSet):
    """K = {y : G y ≤ d, E y = e}, with plain sums (G y)ₖ = Σᵢ Gₖᵢ yᵢ whatever the space's weights.

    A dual active-set method determines the nearest point and its active rows, exactly up to roundoff,
    which moves y by as much over the smallest angle between active rows. The optimality conditions are
    then checked; the result is NaN if the check fails. The derivative, in z, G, d, E and e, is that of
    the projection onto the active rows. A row that holds with equality counts as active, even with a
    zero multiplier. A change of one of several identical rows is distributed over all of them.

    Each bound on a single unknown is a row here. With many of them and few other rows,
    `dvax.sets.ConstrainedBox` is the same set with a faster projection.

    **Arguments:** `G`: an array of shape (rows, *shape of y), a matrix if y is a vector; `d`: a
    vector, whose entries may be +∞; `E`, `e`: equations of the same form, or None.

    **Raises:** `dvax.InputError` if the set is empty or entries are NaN. The projection is NaN if
    traced data describe an empty set.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.Polyhedron(G=jnp.array([[1.0, 1.0], [-1.0, 0.0]]), d=jnp.array([1.0, 0.0]))
    >>> K.project(jnp.array([-1.0, 3.0]), dvax.spaces.Euclidean(2)).tolist()
    [0.0, 1.0]

    ```
    """

    G: jax.Array
    d: jax.Array
    E: jax.Array
    e: jax.Array
    reduced: "_Reduced | None" = eqx.field(repr=False)

    def __init__(self, G: Any, d: Any, E: Any = None, e: Any = None):
        name = "dvax.sets.Polyhedron"
        self.reduced = None
        self.G, self.d = checked_rows(name, G, d, "G", "d")
        if (E is None) != (e is None):
            raise input_error(
                f"{name}(E, e)",
                "one without the other",
                "the equations E y = e need both",
                "Give both or neither",
            )
        if E is None:
            self.E, self.e = (_tree.prepare(lambda a: a[:0], a) for a in (self.G, self.d))
        else:
            self.E, self.e = checked_rows(name, E, e, "E", "e")
            row = jax.ShapeDtypeStruct(self.G.shape[1:], self.G.dtype)
            check_row_shapes(f"{name}(E)", self.E, row)
            _tree.require(
                lambda: jax.jit(has_solution)(self.E, self.e),
                f"{name}(E, e)",
                (self.E, self.e),
                "E y = e must have a solution, or the set is empty and the law has no solution",
                "Remove or correct the equations that contradict the others",
            )
        if _tree.is_concrete((self.G, self.d, self.E, self.e)):
            _check_nonempty(name, *(np.asarray(a) for a in (self.G, self.d, self.E, self.e)))

    def prepared(self, like: Tree, space: AbstractSpace) -> "Polyhedron":
        """Return the same set with what its projections compute from its data alone.

        A program that projects in a loop computes it once, before the loop."""
        return eqx.tree_at(lambda K: K.reduced, self, self._reduce(like, space), is_leaf=_is_none)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        return _nearest(z.reshape(-1), *self._reduced(z, space))[0].reshape(z.shape)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        """Return, for each row, its slack, or minus its multiplier if the row is active.

        The multipliers of linearly dependent rows are not unique. A row without a bound has the
        slack 1."""
        _, is_active, multiplier, slack, _ = rows_at(self, z, space)
        return [jnp.where(is_active, -multiplier, slack)]

    def _reduced(self, z: Tree, space: AbstractSpace) -> "_Reduced":
        return self._reduce(z, space) if self.reduced is None else self.reduced

    def _reduce(self, like: Tree, space: AbstractSpace) -> "_Reduced":
        n = like.size
        root = jnp.sqrt(inverse_weights(space, like)).reshape(-1)
        return _reduce(root, self.G.reshape(-1, n), self.d, self.E.reshape(-1, n), self.e)

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        check_row_shapes("dvax.sets.Polyhedron(G)", self.G, like)


def rows_at(K: Polyhedron, z: jax.Array, space: AbstractSpace) -> tuple[jax.Array, ...]:
    """Return the projection of z and, for each row of G, whether it is active, its multiplier and its
    slack there; and a bound on the factor by which roundoff in active rows moves y. Rows have length
    one, without the part that the equations determine."""
    reduced = K._reduced(z, space)
    y, active, multiplier, dual = _nearest(z.reshape(-1), *reduced)
    slack = reduced.bounds - times(reduced.rows, y / reduced.root - reduced.base)
    condition = jnp.maximum(1.0, _length(dual))
    return y.reshape(z.shape), active > 0, multiplier, slack, condition


class _Reduced(NamedTuple):
    """The data of a polyhedron without its equations: proj_K(z) = root (base + x), where x is the
    projection of `point(z)` onto {x : rows x ≤ bounds} in the null space of the equations.

    `root` is w^{−1/2}: in the coordinates y/root the norm of the space is the Euclidean norm. The rows
    have length one or zero. `base` is the solution of least norm of `equations` x = `values`, and
    `back` their pseudoinverse. `size` has the magnitudes that were subtracted to form the bounds.
    `solvable` is whether the equations have a solution and no bound is −∞ or NaN.
    """

    root: jax.Array
    rows: jax.Array
    bounds: jax.Array
    equations: jax.Array
    values: jax.Array
    back: jax.Array
    base: jax.Array
    size: jax.Array
    solvable: jax.Array

    def onto_null_space(self, x: jax.Array) -> jax.Array:
        if not len(self.values):
            return x
        return x - times(self.back, times(self.equations, x))

    def point(self, z: jax.Array) -> jax.Array:
        """Return the point whose projection in the null space is x."""
        point = z / self.root
        if not len(self.values):
            return point
        residual = times(self.equations, point) - self.values
        return self.onto_null_space(point - self.base - times(self.back, residual))


def _reduce(root: jax.Array, G: Any, d: Any, E: Any, e: Any) -> _Reduced:
    solvable = jnp.all(d > -jnp.inf)
    # A row without a bound is never active.
    has_bound = d != jnp.inf
    G, d = jnp.where(has_bound[:, None], G, 0.0), jnp.where(has_bound, d, 1.0)
    rows, bounds = normalised_conditions(G * root[None, :], d)
    if not len(e):
        base, size = jnp.zeros_like(root), jnp.zeros_like(bounds)
        return _Reduced(root, rows, bounds, E, e, E.T, base, size, solvable)
    equations, values = normalised_conditions(E * root[None, :], e)
    back = pseudoinverse(equations)
    base = times(back, values)
    reduced = _Reduced(root, rows, bounds, equations, values, back, base, bounds, solvable)
    bounds = bounds - times(rows, base)
    rows = jax.vmap(reduced.onto_null_space)(rows)
    # A row whose projection is shorter than this depends linearly on the equations.
    roundoff = float(jnp.finfo(root.dtype).eps) ** dual.SLACK
    is_long = jnp.sum(rows * rows, axis=1) > roundoff**2
    rows, scale = normalise_rows(jnp.where(is_long[:, None], rows, 0.0))
    # The scale of a short row makes its roundoff large, which would not be in the null space.
    rows, again = normalise_rows(jax.vmap(reduced.onto_null_space)(rows))
    scale = scale * again
    bounds = bounds / scale
    return reduced._replace(
        rows=rows,
        bounds=bounds,
        size=lax.stop_gradient(jnp.abs(bounds) + _length(base) / scale),
        solvable=solvable & has_solution(E, e),
    )


@jax.custom_jvp
def _nearest(z: jax.Array, *data: Any) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Return (projection, 1 for active rows of G and else 0, multipliers, B), given the fields of a
    `_Reduced`.

    B is the transposed pseudoinverse of its active rows. The projection is NaN if the set is empty.
    """
    K = _Reduced(*data)
    has_equations = len(K.values) > 0
    nearest = dual.nearest_point(K.rows, K.bounds, K.point(z), K.size)
    x = nearest.x
    if has_equations:
        # Rounding of a distant point leaves the equations by eps|z|. A correction that is not needed
        # would leave the inequalities instead, by a rounding of x.
        corrected = K.onto_null_space(x)
        rounding = _ROUNDINGS * jnp.finfo(z.dtype).eps * (_length(x) + _length(K.base))
        x = jnp.where(_length(corrected - x) > rounding, corrected, x)
    is_valid = nearest.valid & K.solvable
    y = jnp.where(is_valid, x + K.base, jnp.nan) * K.root
    if not has_equations:
        # Without active rows, return z itself: scaling there and back has roundoff.
        y = jnp.where(is_valid & ~jnp.any(nearest.active), z, y)
    return y, nearest.active.astype(z.dtype), nearest.multiplier, nearest.dual


def _length(x: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(jnp.square(x)))


def _is_none(node: Any) -> bool:
    return node is None


def _nearest_jvp(primals: tuple, tangents: tuple) -> tuple:
    y, active, multiplier, inverse = _nearest(*primals)

    def project_on_face(z: jax.Array, *data: Any) -> jax.Array:
        K = _Reduced(*data)
        rows, bounds = (
            jnp.where(active[:, None] > 0, K.rows, 0.0),
            jnp.where(active > 0, K.bounds, 0.0),
        )
        back = as_pseudoinverse(lax.stop_gradient(inverse).T, rows)
        # Sums of products: for a batch of tangents, matrix products would be calls of a library.
        point = K.point(z)
        excess = jnp.sum(rows * point[None, :], axis=1) - bounds
        return K.root * (point - jnp.sum(back * excess[None, :], axis=1) + K.base)

    dy = jvp_of_moving(project_on_face, primals, tangents)
    results = y, active, multiplier, inverse
    return results, (dy, *map(jnp.zeros_like, results[1:]))


_nearest.defjvp(_nearest_jvp, symbolic_zeros=True)


def _check_nonempty(name: str, G: np.ndarray, d: np.ndarray, E: np.ndarray, e: np.ndarray) -> None:
    """Raise an `InputError` if no point satisfies all conditions.

    Solve the linear programme: minimise t subject to G y ≤ d + t and E y = e, with rows of length one.
    """
    import scipy.optimize  # a slow import that only this function needs

    flat, equations = G.reshape(len(d), -1), E.reshape(len(e), -1) if len(e) else None
    length = np.linalg.norm(flat, axis=1)
    length = np.where(length > 0, length, 1.0)
    bounded = d < np.inf
    rows, bounds = (flat / length[:, None])[bounded], (d / length)[bounded]
    violation, text = np.inf, "an entry of d is −∞"
    if np.all(np.isfinite(bounds)):
        size = max(np.max(np.abs(bounds), initial=0.0), np.max(np.abs(e), initial=0.0)) or 1.0
        answer = scipy.optimize.linprog(
            np.append(np.zeros(flat.shape[1]), 1.0),
            A_ub=np.hstack([rows, -np.ones((len(rows), 1))]) if len(rows) else None,
            b_ub=bounds / size if len(rows) else None,
            A_eq=None if equations is None else np.hstack([equations, np.zeros((len(e), 1))]),
            b_eq=None if equations is None else e / size,
            bounds=[(None, None)] * flat.shape[1] + [(0.0, None)],
        )
        # If the linear programme fails, accept the set: the projection checks its own result.
        violation = answer.x[-1] * size if answer.status == 0 else 0.0
        violation = 0.0 if violation <= 1e-6 * size else violation
        if violation > 0.0:
            # The rows with multipliers have a nonnegative sum that no y satisfies.
            among = np.flatnonzero(bounded)[np.abs(answer.ineqlin.marginals) > 1e-9]
            listed = ", ".join(map(str, among[:_LISTED])) + (", …" if len(among) > _LISTED else "")
            text = f"no y satisfies row{'s' * (len(among) > 1)} {listed} of G"
            text += " and E y = e" * bool(len(e))
            text += f": for rows of length one the violation is at least {violation:.3g}"
    if violation > 0.0:
        raise input_error(
            f"{name}(G, d, E, e)",
            f"{len(d)} inequalities and {len(e)} equations, and {text}",
            "the set must not be empty, or the law has no solution",
            "Increase entries of d, or remove conditions that contradict others",
        )
