"""Moduli of affine data too large to be written out as matrices: by their action, with Lanczos."""

from collections.abc import Callable

import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._tree import Tree
from ..spaces import AbstractSpace
from ..vi import analyse, independent
from .lanczos import greatest
from .system import System
from .weights import flat_roots

Action = Callable[[np.ndarray], np.ndarray]


def scaled(
    apply: Callable[[Tree], Tree], space_in: AbstractSpace, like_in: Tree, space_out: AbstractSpace,
    like_out: Tree,
) -> Callable[[jax.Array], jax.Array]:  # fmt: skip
    """A map between two spaces in coordinates in which their norms are Euclidean."""
    flat_in, unravel = jax.flatten_util.ravel_pytree(like_in)
    root_in, root_out = flat_roots(space_in, like_in), flat_roots(space_out, like_out)

    def flat(v: jax.Array) -> jax.Array:
        out = apply(unravel((v / root_in).astype(flat_in.dtype)))
        return root_out * jax.flatten_util.ravel_pytree(out)[0]

    return flat


class Linear:
    """A linear map between two spaces by its action and that of its adjoint, in such coordinates."""

    apply: Callable[[jax.Array], jax.Array]
    adjoint: Callable[[jax.Array], jax.Array]
    size_in: int

    def __init__(
        self, apply: Callable[[Tree], Tree], space_in: AbstractSpace, like_in: Tree,
        space_out: AbstractSpace, like_out: Tree,
    ):  # fmt: skip
        flat_in, _ = jax.flatten_util.ravel_pytree(like_in)
        flat = scaled(apply, space_in, like_in, space_out, like_out)
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
    ) -> "Linear":
        """From both actions."""
        linear = cls.__new__(cls)
        linear.apply, linear.adjoint, linear.size_in = apply, adjoint, size
        return linear

    def norm(self) -> float:
        """‖J‖, from above."""

        @jax.jit
        def gram(v: jax.Array) -> jax.Array:
            return self.adjoint(self.apply(v))

        square = greatest(lambda v: np.asarray(gram(jnp.asarray(v))), self.size_in, least=0.0)
        return float(np.sqrt(max(square, 0.0)))

    def least(self) -> float:
        """inf ⟨Jd, d⟩/‖d‖², from below."""

        @jax.jit
        def minus(v: jax.Array) -> jax.Array:
            return -0.5 * (self.apply(v) + self.adjoint(v))

        return -greatest(lambda v: np.asarray(minus(jnp.asarray(v))), self.size_in)


class Affine:
    """f or h where its code shows that it is affine in x and u, its factors independent of t."""

    def __init__(self, system: System, name: str, t0: float):
        self.system = system
        fn = getattr(system.problem, name)
        self.out = (system.state, system.x0) if name == "f" else (system.control, system.u0)
        self._at = lambda t, xu: fn(t, *xu, system.args)
        self.t0 = jnp.asarray(t0, jnp.result_type(float))

    def proved(self) -> bool:
        """Whether it is."""
        both = self.system.x0, self.system.u0
        slope = lambda t: jax.jvp(lambda v: self._at(t, v), (both,), (both,))[1]  # noqa: E731
        if not independent(slope, self.t0):
            return False
        return analyse(lambda flat: self._at(self.t0, flat), both).affine

    def by_state(self) -> Linear:
        """∂/∂x."""
        system = self.system
        zero = jtu.tree_map(jnp.zeros_like, system.u0)
        return Linear(lambda d: self._push((d, zero)), system.state, system.x0, *self.out)

    def by_response(self) -> Linear:
        """∂/∂u."""
        system = self.system
        return Linear(self.push_response, system.control, system.u0, *self.out)

    def push_response(self, d: Tree) -> Tree:
        return self._push((jtu.tree_map(jnp.zeros_like, self.system.x0), d))

    def _push(self, d: Tree) -> Tree:
        both = self.system.x0, self.system.u0
        return jax.jvp(lambda v: self._at(self.t0, v), (both,), (d,))[1]


def frozen(system: System, h: Affine) -> Linear:
    """∂F/∂y = (I − ∂h/∂u) P⁻¹."""
    space, like = system.control, system.u0
    P = system.problem.operator(system.args)
    slack = Linear(
        lambda v: jtu.tree_map(jnp.subtract, v, h.push_response(v)), space, like, space, like
    )
    # P⁻¹ is its own adjoint in the space, so that what it is computed by need not be transposed.
    inverse = jax.jit(scaled(P.inverse, space, like, space, like))
    return Linear.of(
        lambda v: slack.apply(inverse(v)), lambda w: inverse(slack.adjoint(w)), slack.size_in
    )
