"""Weighted operators a(y) G(y): nonmonotone, but solved as the monotone operator G."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree

from .. import _tree
from .._tree import Tree
from ..errors import InputProblem, Problems, input_error
from ..programs.structure import analyse
from ..spaces import AbstractSpace
from .abstract import RESULTS
from .parameters import describe

_MAX_EIGENVALUE_UNKNOWNS = 256
"""Up to this size the eigenvalues of G's matrix cost at most about two solves."""


class Modulus(NamedTuple):
    """A modulus with its status: "proved" from the code of G, or "declared" by the caller.

    If a proved modulus is not positive, G is not strongly monotone on the whole space. It may still be
    strongly monotone on a K that lies in a subspace.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> F = dvax.vi.Weighted(lambda y, b: 1.0 + y @ y, lambda y, b: 2.0 * y + b, M=1.0)
    >>> modulus = F.modulus(jnp.zeros(2), jnp.ones(2), dvax.spaces.Euclidean(2))
    >>> print(f"{float(modulus.value):.6f}", modulus.status)
    2.000000 proved

    ```
    """

    value: Any
    status: Literal["proved", "declared"]


class Weighted(eqx.Module):
    """F(y) = a(y) G(y) with a number a(y) ≥ M > 0 on K, and G strongly monotone with modulus μ:

        ⟨G(y) − G(z), y − z⟩ ≥ μ‖y − z‖².

    F is then strongly pseudomonotone with modulus γ = Mμ (paper, prop:weighted_strong_pseudomono),
    and need not be monotone. As a(y) > 0, ⟨a(y)G(y), v − y⟩ ≥ 0 and ⟨G(y), v − y⟩ ≥ 0 are equivalent:
    VI(K, aG) and VI(K, G) have the same solutions. So `dvax.solve_vi` solves VI(K, G), without the
    weight, and the certificate uses μ alone: for w ∈ G(y) + N_K(y), a(y)w ∈ F(y) + N_K(y) and

        ‖y − y*‖ ≤ ‖w‖/μ ≤ (a(y)/M) ‖w‖/μ = ‖a(y)w‖/γ,

    so the certificate of G is sharper than that of F by the factor a(y)/M, and needs no M. Derivatives
    are those of the solution of VI(K, G), hence of VI(K, aG).

    `dvax.solve_vi` reports on VI(K, G): `tol` without μ, `residual` and `evaluations` refer to G. It
    evaluates a once, at the computed y. If a(y) ≤ 0, the result is `weight_not_positive` and the error
    bound infinite. If a(y) < M, M is refuted, and with it γ = Mμ: the result is `weight_below_bound`,
    while y and its bound remain valid.

    A load must be inside the factor G: (2 + sin y)(y − q) is weighted, but (2 + sin y) y − q is
    not, and can have three solutions.

    **Arguments:** `a(y, args)`, a number, and `G(y, args)`, both traceable; `M`, a lower bound of a on
    K, and `mu`, the modulus of G, both optional. If `mu` is not given and G is proved to be affine,
    G(y) = Jy + c, the modulus is the smallest eigenvalue of (J + J*)/2 (see `modulus`).

    **Raises:** `dvax.InputError` if M or mu is not positive and finite. If F is called outside
    `dvax.solve_vi`, F(y) is NaN where a(y) is not positive.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> F = dvax.vi.Weighted(lambda y, q: 2 + jnp.sin(y), lambda y, q: y - q, M=1.0, mu=1.0)
    >>> vi = dvax.solve_vi(F, dvax.sets.Box(0.0, 4.7), jnp.array(0.0), args=3.0)
    >>> float(vi.y), vi.solver, bool(vi.error_bound < 1e-12), float(F.gamma)
    (3.0, 'ClosedForm', True, 1.0)

    ```
    """

    a: Callable[[Tree, Any], Any]
    G: Callable[[Tree, Any], Tree]
    M: Any
    mu: Any

    def __init__(
        self,
        a: Callable[[Tree, Any], Any],
        G: Callable[[Tree, Any], Tree],
        *,
        M: Any = None,
        mu: Any = None,
    ):
        self.a, self.G = a, G
        for name, fn in (("a", a), ("G", G)):
            if not callable(fn):
                raise input_error(
                    f"dvax.vi.Weighted({name})", describe(fn), "it must be callable as (y, args)",
                    f"Write {name}=lambda y, args: ...",
                )  # fmt: skip
        self.M = _positive("M", M, "a must be bounded away from 0, otherwise Mμ is not a modulus")
        self.mu = _positive("mu", mu, "G must be strongly monotone, otherwise y* may not be unique")

    def __call__(self, y: Tree, args: Any = None) -> Tree:
        """Return F(y) = a(y) G(y), or NaN where a(y) is not positive."""
        weight = self.weight(y, args)
        return _tree.scale(jnp.where(weight > 0, weight, jnp.nan), self.G(y, args))

    @property
    def gamma(self) -> Any:
        """The modulus γ = Mμ of F, or None if M or mu was not given."""
        return None if self.M is None or self.mu is None else self.M * self.mu

    def weight(self, y: Tree, args: Any = None) -> jax.Array:
        """Return a(y) after checking that it is one number."""
        weight = jnp.asarray(self.a(y, args))
        if weight.shape != ():
            raise input_error(
                "dvax.vi.Weighted(a)",
                f"a value of shape {weight.shape}",
                "a(y) must be one number, so that it cancels from ⟨F(y), v − y⟩ ≥ 0 for every v",
                "Return a scalar",
            )
        return weight

    def modulus(self, like: Tree, args: Any, space: AbstractSpace) -> Modulus | None:
        """Return μ in `space`: the declared one, or one proved if the code of G shows G(y) = Jy + c.

        Then ⟨G(y) − G(z), y − z⟩ = ⟨Jd, d⟩, whose minimum for ‖d‖ = 1 is the smallest eigenvalue of
        (J + J*)/2; a bound on its rounding error is subtracted. The result is None if G is not proved
        affine, or has more than 256 unknowns.
        """
        if self.mu is not None:
            return Modulus(self.mu, "declared")

        def G(y: Tree) -> Tree:
            return self.G(y, args)

        size = sum(leaf.size for leaf in jtu.tree_leaves(like))
        if size > _MAX_EIGENVALUE_UNKNOWNS or not analyse(G, like).affine:
            return None
        return Modulus(jax.lax.stop_gradient(_least_eigenvalue(G, like, space)), "proved")

    def check_weight(
        self, y: Tree, args: Any, result: RESULTS, bound: jax.Array | None
    ) -> tuple[RESULTS, jax.Array | None]:
        """Return the result and error bound of VI(K, G), revised by the value of a(y)."""
        weight = jax.lax.stop_gradient(self.weight(y, args))
        solved = result == RESULTS.successful
        if self.M is not None:
            # M may be the exact minimum of a, computed with different rounding.
            below = weight < self.M * (1 - 64 * jnp.finfo(weight.dtype).eps)
            result = RESULTS.where(solved & below, RESULTS.weight_below_bound, result)
        positive = weight > 0
        result = RESULTS.where(solved & ~positive, RESULTS.weight_not_positive, result)
        result = RESULTS.where(solved & ~jnp.isfinite(weight), RESULTS.nonfinite, result)
        return result, None if bound is None else jnp.where(positive, bound, jnp.inf)


def reject_moduli_of_product(gamma: Any, L_F: Any) -> None:
    """Raise an `InputError` if moduli of aG are given to a solve of VI(K, G)."""
    moduli = {"gamma": gamma, "L_F": L_F}
    problems = Problems(
        InputProblem(
            f"dvax.solve_vi({name})",
            _tree.short(value),
            "a Weighted operator brings its own moduli: the solver solves VI(K, G), whose moduli "
            "differ from those of a(y)G(y)",
            "Give M and mu to dvax.vi.Weighted, or solve VI(K, G) itself: dvax.solve_vi(F.G, ...)",
        )
        for name, value in moduli.items()
        if value is not None
    )
    problems.raise_any()


def _least_eigenvalue(G: Callable[[Tree], Tree], like: Tree, space: AbstractSpace) -> jax.Array:
    flat, unflatten = ravel_pytree(_tree.zeros_like(like))

    def slope(d: jax.Array) -> jax.Array:
        return ravel_pytree(jax.jvp(G, (unflatten(flat),), (unflatten(d),))[1])[0]

    matrix = jax.vmap(slope, out_axes=1)(jnp.eye(flat.size, dtype=flat.dtype))
    weights = jtu.tree_map(
        lambda w, leaf: jnp.broadcast_to(w, leaf.shape).astype(leaf.dtype), space.weights(), like
    )
    # In terms of √w d, ⟨Jd, d⟩ = Σ wᵢ(Jd)ᵢdᵢ is a Euclidean quadratic form and ‖d‖ the Euclidean norm.
    root = jnp.sqrt(ravel_pytree(weights)[0])
    matrix = root[:, None] * matrix / root[None, :]
    eigenvalues = jnp.linalg.eigvalsh(0.5 * (matrix + matrix.T))
    rounding = 8 * flat.size * jnp.finfo(flat.dtype).eps * jnp.linalg.norm(matrix)
    return eigenvalues[0] - rounding


def _positive(name: str, value: Any, why: str) -> Any:
    if value is None:
        return None
    value = _tree.as_float(value, f"dvax.vi.Weighted({name})")
    if _tree.shapes(value) != ():
        raise input_error(
            f"dvax.vi.Weighted({name})", f"shape {_tree.shapes(value)}", "it must be one number",
            "Give the smallest of them",
        )  # fmt: skip
    _tree.require(
        lambda: bool(value > 0) and bool(jnp.isfinite(value)),
        f"dvax.vi.Weighted({name})",
        value,
        f"it must be positive and finite: {why}",
        "Omit it if it is unknown",
    )
    return value
