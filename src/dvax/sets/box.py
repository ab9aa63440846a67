"""Boxes: pointwise intervals."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from .abstract import AbstractSet


class Box(AbstractSet):
    """K = {y : lower ≤ y ≤ upper} pointwise; bounds may be infinite.

    The projection clips pointwise. This is the projection in every space with a diagonal inner
    product (Euclidean, or with quadrature weights), as all spaces of dvax have. It would not be the
    projection in the inner product of a full mass matrix.

    **Arguments:** `lower`, `upper`: numbers or arrays, broadcast against y.

    **Raises:** `dvax.InputError` if lower > upper, a bound is NaN, or lower = +∞.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.Box(0.0, jnp.inf)
    >>> K.project(jnp.array([-1.0, 2.0]), dvax.spaces.Euclidean(2)).tolist()
    [0.0, 2.0]

    ```
    """

    lower: jax.Array
    upper: jax.Array

    def __init__(self, lower: Any, upper: Any):
        self.lower = _tree.as_array(lower, "dvax.sets.Box(lower)")
        self.upper = _tree.as_array(upper, "dvax.sets.Box(upper)")
        shapes = jnp.shape(self.lower), jnp.shape(self.upper)
        if shapes[0] != shapes[1]:
            _check_shapes(*shapes)
        for name, bound in (("lower", self.lower), ("upper", self.upper)):
            _tree.check_not_nan(f"dvax.sets.Box({name})", bound)
        # In NumPy: JAX compiles a program for each check, which takes longer than 100 small steps.
        _tree.require(
            lambda: np.all(np.asarray(self.lower) <= np.asarray(self.upper)),
            "dvax.sets.Box(lower, upper)",
            _crossing(self.lower, self.upper),
            "lower ≤ upper must hold everywhere, or the set is empty and the law has no solution",
            "Swap the bounds, or widen the interval",
        )
        _tree.require(
            lambda: (
                np.all(np.asarray(self.lower) < np.inf) & np.all(np.asarray(self.upper) > -np.inf)
            ),
            "dvax.sets.Box(lower, upper)",
            (self.lower, self.upper),
            "lower < +∞ and upper > −∞ must hold, or the set is empty",
            "Use lower = −∞ and upper = +∞ for unbounded sides",
        )

        if not _tree.is_concrete((self.lower, self.upper)):
            # Traced bounds have no values yet. Where they cross (or are NaN) the projection is
            # infinite, so that an empty set stops a solve.
            self.lower = dvax_lower_or_inf(self.lower, self.upper)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        # At a bound the derivative is that of the bound: the convention of AbstractSet. Selections
        # are also faster than minimum and maximum, which handle NaN and signed zeros.
        lower, upper = self.intervals(z)
        return jnp.where(z <= lower, lower, jnp.where(z >= upper, upper, z))

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        lower, upper = self.intervals(z)
        return [z - lower, upper - z]

    def intervals(self, like: Tree) -> tuple[Tree, Tree]:
        def one(bound: Any) -> jax.Array:
            # Bounds given as Python numbers take the type of `like`.
            common = jnp.result_type(bound, like)
            bound = bound if bound.dtype == common else jnp.asarray(bound, common)
            return jnp.broadcast_to(bound, jnp.shape(like))

        return one(self.lower), one(self.upper)

    def check(self, like: Tree) -> None:
        if isinstance(like, tuple):
            raise input_error(
                "dvax.sets.Box",
                "one box",
                f"y = P u is a tuple of {len(like)} parts",
                "Give one set a part: dvax.sets.Product(...)",
            )
        shape = jnp.shape(like)
        for name, bound in (("lower", self.lower), ("upper", self.upper)):
            try:
                fits = jnp.broadcast_shapes(bound.shape, shape) == shape
            except ValueError:
                fits = False
            if not fits:
                raise input_error(
                    f"dvax.sets.Box({name})",
                    f"shape {bound.shape}",
                    f"the bound must broadcast against y = P u, of shape {shape}",
                    "Give the bound that shape, or set control_space= of dvax.Problem",
                )


def _check_shapes(lower: tuple[int, ...], upper: tuple[int, ...]) -> None:
    try:
        np.broadcast_shapes(lower, upper)
    except ValueError:
        raise input_error(
            "dvax.sets.Box(lower, upper)", f"shapes {lower} and {upper}",
            "the shapes of both bounds must broadcast",
            "Give both the same shape, or a number for all entries",
        ) from None  # fmt: skip


def _crossing(lower: jax.Array, upper: jax.Array) -> Any:
    """Return the bounds for a message: those of the first entry where they cross or are NaN."""
    if not _tree.is_concrete((lower, upper)):
        return lower, upper
    low, up = np.broadcast_arrays(np.asarray(lower), np.asarray(upper))
    wrong = np.argwhere(~(low <= up))
    if not len(wrong):
        return lower, upper
    index = tuple(map(int, wrong[0]))
    where = f" in entry {index} ({len(wrong)} of {low.size} such entries)" if index else ""
    # Seventeen digits distinguish any two numbers.
    digits = 9 if f"{low[index]:.9g}" != f"{up[index]:.9g}" else 17
    return _tree.Text(f"lower = {low[index]:.{digits}g}, upper = {up[index]:.{digits}g}{where}")


@jax.jit
def dvax_lower_or_inf(lower: jax.Array, upper: jax.Array) -> jax.Array:
    """Return the lower bound, or +∞ where the interval is empty.

    `dvax.programs.enclosure` has a rule for a jitted function of this name: its value is the lower
    bound wherever the set is not empty.
    """
    return jnp.where(lower <= upper, lower, jnp.inf)
