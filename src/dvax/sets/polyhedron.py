"""Polyhedra: linear inequalities and equations."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from . import _dual_active_set as dual
from ._weights import inverse_weights
from .abstract import AbstractSet
from .affine import consistent, fits_rows, linear_rows, unit, unit_rows


class Polyhedron(AbstractSet):
    """K = {y : G y ≤ d, E y = e}, with plain sums (G y)ₖ = Σᵢ Gₖᵢ yᵢ whatever the space's weights.

    The nearest point and the rows that hold it are found by a dual active-set method, exactly but
    for rounding (2e-12 of the sizes in play, in double precision), and checked; what fails the check
    is NaN. Its derivative is that of the projection onto the rows that hold it, in z, G, d, E and e.
    A row that a point just touches counts as holding it; rows that repeat each other share what
    moves one of them alone.

    **Arguments:** `G`: an array of shape (rows, *shape of y), a matrix where y is a vector; `d`: a
    vector, whose entries may be +∞; `E`, `e`: equations, shaped alike, or None.

    **Raises:** `dvax.InputError` where the set is empty, or entries are NaN. A traced one that turns
    out to be empty projects to NaN.

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

    def __init__(self, G: Any, d: Any, E: Any = None, e: Any = None):
        name = "dvax.sets.Polyhedron"
        self.G, self.d = linear_rows(name, G, d, "G", "d")
        if (E is None) != (e is None):
            raise InputError(
                InputProblem(
                    f"{name}(E, e)",
                    "one without the other",
                    "E y = e needs both",
                    "Give both, or neither",
                )
            )
        if E is None:
            self.E, self.e = jnp.zeros((0, *self.G.shape[1:]), self.G.dtype), self.d[:0]
        else:
            self.E, self.e = linear_rows(name, E, e, "E", "e")
            fits_rows(f"{name}(E)", self.E, self.G[0])
            _tree.require(
                lambda: consistent(self.E, self.e),
                f"{name}(E, e)",
                (self.E, self.e),
                "E y = e has a solution, or the set is empty and the law has none",
                "Drop or mend the equations that contradict the others",
            )
        if _tree.is_concrete((self.G, self.d, self.E, self.e)):
            _refuse_empty(name, *(np.asarray(a) for a in (self.G, self.d, self.E, self.e)))

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        return _nearest(*self._flat(z, space))[0].reshape(z.shape)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        """Row by row the slack, or less the force of a row that holds. Of rows that repeat each other
        some share the force that others might as well exert."""
        flat, root, G, d, E, e = self._flat(z, space)
        y, held, force = _nearest(flat, root, G, d, E, e)
        rows, bounds = _scaled(G, d, root)
        return [jnp.where(held > 0, -force, bounds - rows @ (y / root))]

    def _flat(self, z: Tree, space: AbstractSpace) -> tuple:
        n = z.size
        root = jnp.sqrt(inverse_weights(space, z)).reshape(-1)
        return z.reshape(-1), root, self.G.reshape(-1, n), self.d, self.E.reshape(-1, n), self.e

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        fits_rows("dvax.sets.Polyhedron(G)", self.G, like)


@jax.custom_jvp
def _nearest(
    z: jax.Array, root: jax.Array, G: jax.Array, d: jax.Array, E: jax.Array, e: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(the projection, NaN where there is none; 1 for rows of G that hold it, else 0; their forces).

    `root` is w^{−1/2}: in the coordinates y/root the norm of the space is the plain one.
    """
    point, rows, bounds = z / root, *_scaled(G, d, root)
    if len(e):
        # Into the subspace of the equations first: inequalities alone are left.
        equations, values = _scaled(E, e, root)
        back = jnp.linalg.pinv(equations)
        base = back @ values
        point = point - base - back @ (equations @ point - values)
        point = point - back @ (equations @ point)
        bounds = bounds - rows @ base
        rows = rows - (rows @ back) @ equations
        # Shorter than this, of what was one, a row is a sum of the equations' but for rounding.
        lost = float(jnp.finfo(z.dtype).eps) ** dual.SLACK
        rows, scale = unit(jnp.where(_length(rows)[:, None] > lost, rows, 0.0))
        bounds = bounds / scale
        size = (jnp.abs(bounds) + jnp.linalg.norm(base)) / scale
        solvable = consistent(E, e)
    else:
        base, size, solvable = jnp.zeros_like(point), jnp.zeros_like(bounds), True
    found = dual.nearest(rows, bounds, point, size)
    y = jnp.where(found.good & solvable, found.x + base, jnp.nan)
    # Nothing held: z itself, without the rounding of the way there and back.
    free = found.good & ~jnp.any(found.held) & (len(e) == 0)
    return jnp.where(free, z, y * root), found.held.astype(z.dtype), found.force


@_nearest.defjvp
def _nearest_jvp(primals: tuple, tangents: tuple) -> tuple:
    y, held, force = _nearest(*primals)

    def on_face(z, root, G, d, E, e) -> jax.Array:
        # Rows that do not hold take no part; d may be infinite there.
        rows, bounds = _scaled(
            jnp.concatenate([E, jnp.where(held[:, None] > 0, G, 0.0)]),
            jnp.concatenate([e, jnp.where(held > 0, d, 0.0)]),
            root,
        )
        point = z / root
        return root * (point - jnp.linalg.pinv(rows) @ (rows @ point - bounds))

    _, change = jax.jvp(on_face, primals, tangents)
    return (y, held, force), (change, jnp.zeros_like(held), jnp.zeros_like(force))


def _scaled(G: jax.Array, d: jax.Array, root: jax.Array) -> tuple[jax.Array, jax.Array]:
    return unit_rows(G * root[None, :], d)


def _length(rows: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(rows * rows, axis=1))


def _refuse_empty(name: str, G: np.ndarray, d: np.ndarray, E: np.ndarray, e: np.ndarray) -> None:
    """Raise an `InputError` where no point satisfies all conditions.

    The linear programme: the least t with G y ≤ d + t, for rows of length one.
    """
    import scipy.optimize  # heavy, and needed for this alone

    flat, equations = G.reshape(len(d), -1), E.reshape(len(e), -1) if len(e) else None
    length = np.linalg.norm(flat, axis=1)
    length = np.where(length > 0, length, 1.0)
    known = d < np.inf
    rows, bounds = (flat / length[:, None])[known], (d / length)[known]
    missing = np.inf
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
        # Where the programme itself could not be solved nothing is known, and the projection, which
        # checks what it finds, has the last word.
        missing = answer.x[-1] * size if answer.status == 0 else 0.0
        missing = 0.0 if missing <= 1e-6 * size else missing
    if missing > 0.0:
        raise InputError(
            InputProblem(
                f"{name}(G, d, E, e)",
                f"{len(d)} inequalities and {len(e)} equations that no y satisfies: the best one "
                f"misses some row, scaled to length one, by {missing:.3g}",
                "the set must hold a point, or the law has no solution",
                "Raise entries of d, or drop conditions that contradict others",
            )
        )
