"""Moduli of affine data too large for matrices: matrix-free, by Lanczos' method."""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._tree import Tree
from ..programs.derivatives_of_operations import has_derivative
from ..sets._weights import flat_roots
from ..spaces import AbstractSpace
from ..vi import analyse, independent
from .lanczos import largest_eigenvalue_bound
from .system import System


def in_euclidean_coordinates(
    apply: Callable[[Tree], Tree], space_in: AbstractSpace, like_in: Tree, space_out: AbstractSpace,
    like_out: Tree,
) -> Callable[[jax.Array], jax.Array]:  # fmt: skip
    """Return a map between two spaces in coordinates in which their norms are Euclidean."""
    flat_in, unravel = jax.flatten_util.ravel_pytree(like_in)
    root_in, root_out = flat_roots(space_in, like_in), flat_roots(space_out, like_out)

    def flat(v: jax.Array) -> jax.Array:
        out = apply(unravel((v / root_in).astype(flat_in.dtype)))
        return root_out * jax.flatten_util.ravel_pytree(out)[0]

    return flat


class LinearMap:
    """A linear map between two spaces and its adjoint, in Euclidean coordinates."""

    apply: Callable[[jax.Array], jax.Array]
    adjoint: Callable[[jax.Array], jax.Array]
    size_in: int

    def __init__(
        self, apply: Callable[[Tree], Tree], space_in: AbstractSpace, like_in: Tree,
        space_out: AbstractSpace, like_out: Tree,
    ):  # fmt: skip
        flat_in, _ = jax.flatten_util.ravel_pytree(like_in)
        flat = in_euclidean_coordinates(apply, space_in, like_in, space_out, like_out)
        transposed = jax.linear_transpose(flat, jax.ShapeDtypeStruct(flat_in.shape, flat_in.dtype))
        self.size_in = flat_in.size
        self.apply = jax.jit(flat)
        self.adjoint = jax.jit(lambda w: transposed(w)[0])

    @classmethod
    def of(
        cls,
        apply: Callable[[jax.Array], jax.Array],
        adjoint: Callable[[jax.Array], jax.Array],
        size: int,
    ) -> "LinearMap":
        """Return the linear map with these actions."""
        linear_map = cls.__new__(cls)
        linear_map.apply, linear_map.adjoint, linear_map.size_in = apply, adjoint, size
        return linear_map

    def norm(self) -> float:
        """Return an upper bound on ‖J‖."""

        @jax.jit
        def gram(v: jax.Array) -> jax.Array:
            return self.adjoint(self.apply(v))

        square = largest_eigenvalue_bound(
            lambda v: np.asarray(gram(jnp.asarray(v))), self.size_in, least=0.0
        )
        return float(np.sqrt(max(square, 0.0)))

    def smallest_quotient(self) -> float:
        """Return a lower bound on inf ⟨Jd, d⟩/‖d‖²."""

        @jax.jit
        def negative_symmetric_part(v: jax.Array) -> jax.Array:
            return -0.5 * (self.apply(v) + self.adjoint(v))

        return -largest_eigenvalue_bound(
            lambda v: np.asarray(negative_symmetric_part(jnp.asarray(v))), self.size_in
        )


class AffineMap:
    """f or h, for which `is_proved` tests whether it is affine in x and u with factors independent of
    t."""

    def __init__(self, system: System, name: str, t0: float):
        self.system = system
        fn = getattr(system.problem, name)
        self.out = (system.state, system.x0) if name == "f" else (system.control, system.u0)
        self._at = lambda t, xu: fn(t, *xu, system.args)
        self.t0 = jnp.asarray(t0, jnp.result_type(float))

    def is_proved(self) -> bool:
        """Return whether the code shows that the map is affine with constant factors."""
        both = self.system.x0, self.system.u0

        def slope(t: Any) -> Tree:
            return jax.jvp(lambda v: self._at(t, v), (both,), (both,))[1]

        if not has_derivative(lambda v: self._at(self.t0, v), both):
            return False
        if not independent(slope, self.t0):
            return False
        return analyse(lambda v: self._at(self.t0, v), both).affine

    def by_state(self) -> LinearMap:
        """Return ∂/∂x."""
        system = self.system
        zero = jtu.tree_map(jnp.zeros_like, system.u0)
        return LinearMap(lambda d: self._push((d, zero)), system.state, system.x0, *self.out)

    def by_response(self) -> LinearMap:
        """Return ∂/∂u."""
        system = self.system
        return LinearMap(self.push_response, system.control, system.u0, *self.out)

    def push_response(self, d: Tree) -> Tree:
        """Return the derivative in the direction d of u."""
        return self._push((jtu.tree_map(jnp.zeros_like, self.system.x0), d))

    def _push(self, d: Tree) -> Tree:
        both = self.system.x0, self.system.u0
        return jax.jvp(lambda v: self._at(self.t0, v), (both,), (d,))[1]


def frozen_derivative(system: System, h: AffineMap) -> LinearMap:
    """Return ∂F/∂y = (I − ∂h/∂u) P⁻¹."""
    space, like = system.control, system.u0
    P = system.problem.operator(system.args)
    I_minus_H_u = LinearMap(
        lambda v: jtu.tree_map(jnp.subtract, v, h.push_response(v)), space, like, space, like
    )
    # P⁻¹ is self-adjoint in the space, so its code need not be transposed.
    inverse = jax.jit(in_euclidean_coordinates(P.inverse, space, like, space, like))
    return LinearMap.of(
        lambda v: I_minus_H_u.apply(inverse(v)),
        lambda w: inverse(I_minus_H_u.adjoint(w)),
        I_minus_H_u.size_in,
    )
