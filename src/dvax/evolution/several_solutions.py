"""A warning where the law of a problem may have several solutions, of which a run would follow one.

Each solver of laws accepts a point with a small residual, and so finds one of several solutions without
a sign of the others. A wrong sign of u in h is enough.
"""

import itertools
import warnings
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree

from .. import _tree
from .._tree import Tree
from ..problem import Problem
from ..programs.structure import analyse
from .signature import Signature, flatten

_LARGEST = 64
"""Most unknowns of a law whose matrix is formed."""

_MAX_MINORS = 12
"""Most unknowns for which all principal minors are computed."""

_ROUNDING = 1e-8
"""Eigenvalues and minors below this share of the largest one count as zero."""

_SCALES = (1.0, 1e-3, 1e3)
"""Distances at which two points of K are sought."""


def warn_of_several_solutions(problem: Problem, t0: Any, x0: Tree, args: Any, moduli: Any) -> None:
    """Warn if the law of a problem is affine and two points of K prove that it is not monotone.

    Where `moduli` declares γ, the law has one solution. On a box it has at most one if all principal
    minors of its matrix are positive: F is then a P function (Facchinei and Pang 2003, proposition
    3.5.10).
    """
    if getattr(moduli, "gamma", None) is not None:
        return
    t = jnp.asarray(np.asarray(t0, _tree.dtype(x0)))
    pair = _pair(problem, t, x0, _tree.as_arrays(args))
    if pair is not None:
        y, z, product = pair
        warnings.warn(
            "The law may have several solutions, or none, and the run follows one of them: F(y) = P⁻¹y "
            f"− h(t, x, P⁻¹y) is not monotone on K at t = {float(t):g}. For y = {_text(y)} and z = "
            f"{_text(z)} in K, ⟨F(z) − F(y), z − y⟩ = {product:.3g} < 0. Check the sign of the way in "
            "which h depends on u. (Where a modulus γ > 0 of strong pseudomonotonicity is known, "
            "declare it in constants=.)",
            stacklevel=4,
        )


def _text(point: Tree) -> str:
    """Return a point as short text."""
    numbers = {"float_kind": "{:.3g}".format}
    options: dict[str, Any] = dict(threshold=6, edgeitems=2, separator=", ", formatter=numbers)
    parts = [np.array2string(np.asarray(leaf), **options) for leaf in jtu.tree_leaves(point)]
    return " ".join((parts[0] if len(parts) == 1 else f"({', '.join(parts)})").split())


def _pair(problem: Problem, t: jax.Array, x: Tree, args: Any) -> tuple[Tree, Tree, float] | None:
    """Return two points of K and the negative product of their differences, or None."""
    like = problem.zero_control(x)
    size = sum(leaf.size for leaf in jtu.tree_leaves(like))
    if size > _LARGEST:
        return None
    K, law = problem.set_at(t, args), problem.frozen(t, x, args)
    structure, is_box = analyse(law, like), K.intervals(like) is not None
    # A run that solves such a law in closed form says itself where its factor is not positive.
    if not structure.affine or structure.isotropic or (structure.pointwise and is_box):
        return None
    numbers, signature = flatten((problem,), (t, x, like, args), None)
    M = np.asarray(_matrix(numbers, signature))
    if not np.isfinite(M).all():
        return None
    values, vectors = np.linalg.eigh(0.5 * (M + M.T))
    is_negative = values < -_ROUNDING * np.max(np.abs(values))
    if not is_negative.any() or (is_box and size <= _MAX_MINORS and _has_positive_minors(M)):
        return None
    space, unravel = problem.spaces(x)[1], ravel_pytree(like)[1]
    project = jax.jit(lambda v: K.project(unravel(v), space))
    centre = ravel_pytree(project(np.zeros(size, M.dtype)))[0]
    for k, scale in itertools.product(np.flatnonzero(is_negative), _SCALES):
        length = scale * (1.0 + np.linalg.norm(centre))
        y, z = (project(centre + sign * length * vectors[:, k]) for sign in (-1.0, 1.0))
        difference = _tree.sub(z, y)
        d = ravel_pytree(difference)[0]
        # Where K excludes this direction, the difference is rounding.
        if np.linalg.norm(d) <= 1e3 * np.finfo(M.dtype).eps * length:
            continue
        product = float(space.inner(unravel(jnp.asarray(M @ d)), difference))
        squared = float(space.inner(difference, difference))
        if product < -_ROUNDING * np.max(np.abs(values)) * squared:
            return y, z, product
    return None


def _has_positive_minors(M: np.ndarray) -> bool:
    """Return whether all principal minors are positive, and not just by rounding."""
    for size in range(1, len(M) + 1):
        which = np.array(list(itertools.combinations(range(len(M)), size)))
        minors = M[which[:, :, None], which[:, None, :]]
        # By Hadamard's inequality no determinant exceeds the product of the norms of its rows.
        largest = np.prod(np.linalg.norm(minors, axis=2), axis=1)
        if np.any(np.linalg.det(minors) <= 8 * size * np.finfo(M.dtype).eps * largest):
            return False
    return True


@partial(jax.jit, static_argnums=1)
def _matrix(numbers: list[Any], signature: Signature) -> jax.Array:
    """Return the matrix of an affine law."""
    (problem,), (t, x, like, args) = signature.unflatten(numbers)
    start, unravel = ravel_pytree(like)
    F = problem.frozen(t, x, args)
    return jax.jacfwd(lambda v: ravel_pytree(F(unravel(v)))[0])(start)
