"""Weighted operators a(y) G(y): a nonmonotone class that is no harder than a monotone one."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..programs.structure import analyse
from ..spaces import AbstractSpace
from .abstract import RESULTS
from .parameters import shown

_PROVED = 256
"""Up to so many unknowns the eigenvalues of G's matrix cost no more than about two solves."""


class Modulus(NamedTuple):
    """A modulus and how it is known: "proved", from the code of G, or "declared" by the caller.

    A proved one that is not positive says that G is not strongly monotone on the whole space; on a
    K that lies in a subspace it may still be.
    """

    value: Any
    status: Literal["proved", "declared"]


class Weighted(eqx.Module):
    """F(y) = a(y) G(y) with a number a(y) ≥ M > 0 on K, and G strongly monotone with modulus μ:

        ⟨G(y) − G(z), y − z⟩ ≥ μ‖y − z‖².

    F is then strongly pseudomonotone with modulus γ = Mμ (paper, prop:weighted_strong_pseudomono),
    and need not be monotone. As a(y) > 0, ⟨a(y)G(y), v − y⟩ ≥ 0 and ⟨G(y), v − y⟩ ≥ 0 say the same:
    VI(K, aG) and VI(K, G) have the same solutions. So `dvax.solve_vi` solves VI(K, G), without the
    weight, and the certificate rests on μ alone: for w ∈ G(y) + N_K(y), a(y)w ∈ F(y) + N_K(y) and

        ‖y − y*‖ ≤ ‖w‖/μ ≤ (a(y)/M) ‖w‖/μ = ‖a(y)w‖/γ,

    so what G's certificate says is sharper than F's own by the factor a(y)/M, and needs no M.
    Derivatives are those of the solution of VI(K, G), hence of VI(K, aG).

    `dvax.solve_vi` reports on VI(K, G): `tol` without μ, `residual` and `evaluations` are those of
    G. At the y that it found it evaluates a once: where a(y) ≤ 0 the result is `weight_not_positive`
    and the error bound infinite; where a(y) < M, M is refuted, and with it γ = Mμ: the result is
    `weight_below_bound`, while y and its bound hold.

    A drive must sit inside the bracket: (2 + sin y)(y − q) is weighted, (2 + sin y) y − q is not,
    and can have three solutions.

    **Arguments:** `a(y, args)`, a number, and `G(y, args)`, both traceable; `M`, a lower bound of a
    on K, and `mu`, the modulus of G, where they are known. Where `mu` is not given and G is proved
    to be affine, G(y) = Jy + c, it is the least eigenvalue of (J + J*)/2 (see `modulus`).

    **Raises:** `dvax.InputError` where M or mu is not positive and finite. Called outside
    `dvax.solve_vi`, F(y) is NaN where a(y) is not positive.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> F = dvax.vi.Weighted(lambda y, q: 2 + jnp.sin(y), lambda y, q: y - q, M=1.0, mu=1.0)
    >>> vi = dvax.solve_vi(F, dvax.sets.Box(0.0, 4.7), jnp.array(0.0), args=3.0)
    >>> float(vi.y), vi.solver, bool(vi.error_bound < 1e-12), float(F.gamma)
    (3.0, 'Closed', True, 1.0)

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
                raise InputError(
                    InputProblem(
                        f"dvax.vi.Weighted({name})", shown(fn), "it must be callable as (y, args)",
                        f"Write {name}=lambda y, args: ...",
                    )
                )  # fmt: skip
        self.M = _positive("M", M, "a must be bounded away from 0, or Mμ is no modulus")
        self.mu = _positive("mu", mu, "G must be strongly monotone, or uniqueness is not known")

    def __call__(self, y: Tree, args: Any = None) -> Tree:
        """F(y) = a(y) G(y), NaN where a(y) is not positive."""
        weight = self.weight(y, args)
        return _tree.scale(jnp.where(weight > 0, weight, jnp.nan), self.G(y, args))

    @property
    def gamma(self) -> Any:
        """γ = Mμ of F, or None where M or mu was not given."""
        return None if self.M is None or self.mu is None else self.M * self.mu

    def weight(self, y: Tree, args: Any = None) -> jax.Array:
        """a(y), checked to be one number."""
        weight = jnp.asarray(self.a(y, args))
        if weight.shape != ():
            raise InputError(
                InputProblem(
                    "dvax.vi.Weighted(a)",
                    f"a value of shape {weight.shape}",
                    "a(y) must be one number: only that can be divided out of every ⟨F(y), v − y⟩",
                    "Return a scalar",
                )
            )
        return weight

    def modulus(self, like: Tree, args: Any, space: AbstractSpace) -> Modulus | None:
        """μ in `space`: as declared; else proved, where the code of G shows that G(y) = Jy + c.

        Then ⟨G(y) − G(z), y − z⟩ = ⟨Jd, d⟩, whose least value for ‖d‖ = 1 is the least eigenvalue
        of (J + J*)/2, here lowered by what rounding may have done. None where G is not seen to be
        affine, or has more than 256 unknowns.
        """
        if self.mu is not None:
            return Modulus(self.mu, "declared")
        G = lambda y: self.G(y, args)  # noqa: E731
        size = sum(leaf.size for leaf in jtu.tree_leaves(like))
        if size > _PROVED or not analyse(G, like).affine:
            return None
        return Modulus(jax.lax.stop_gradient(_least_eigenvalue(G, like, space)), "proved")

    def judged(
        self, y: Tree, args: Any, result: RESULTS, bound: jax.Array | None
    ) -> tuple[RESULTS, jax.Array | None]:
        """What a(y) leaves of a success and of an error bound for VI(K, G)."""
        weight = jax.lax.stop_gradient(self.weight(y, args))
        solved = result == RESULTS.successful
        if self.M is not None:
            # M may be the very minimum of a, and computed in another order.
            below = weight < self.M * (1 - 64 * jnp.finfo(weight.dtype).eps)
            result = RESULTS.where(solved & below, RESULTS.weight_below_bound, result)
        positive = weight > 0
        result = RESULTS.where(solved & ~positive, RESULTS.weight_not_positive, result)
        result = RESULTS.where(solved & ~jnp.isfinite(weight), RESULTS.nonfinite, result)
        return result, None if bound is None else jnp.where(positive, bound, jnp.inf)


def moduli_belong_to_the_parts(gamma: Any, L_F: Any) -> None:
    """Raise an `InputError` where moduli of aG are given to a solve of VI(K, G)."""
    given = {"gamma": gamma, "L_F": L_F}
    wrong = [
        InputProblem(
            f"dvax.solve_vi({name})",
            _tree.short(value),
            "a Weighted operator brings its own moduli, and those of a(y)G(y) are not those of G, "
            "which is what is solved",
            "Give M and mu to dvax.vi.Weighted, or solve VI(K, G) itself: dvax.solve_vi(F.G, ...)",
        )
        for name, value in given.items()
        if value is not None
    ]
    if wrong:
        raise InputError(*wrong)


def _least_eigenvalue(G: Callable[[Tree], Tree], like: Tree, space: AbstractSpace) -> jax.Array:
    flat, unflatten = ravel_pytree(_tree.zeros_like(like))
    slope = lambda d: ravel_pytree(jax.jvp(G, (unflatten(flat),), (unflatten(d),))[1])[0]  # noqa: E731
    matrix = jax.vmap(slope, out_axes=1)(jnp.eye(flat.size, dtype=flat.dtype))
    weights = jtu.tree_map(
        lambda w, leaf: jnp.broadcast_to(w, leaf.shape).astype(leaf.dtype), space.weights(), like
    )
    # ⟨Jd, d⟩ = Σ wᵢ(Jd)ᵢdᵢ is a plain quadratic form of √w d, whose plain norm is ‖d‖.
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
        raise InputError(
            InputProblem(
                f"dvax.vi.Weighted({name})", f"shape {_tree.shapes(value)}", "it is one number",
                "Give the least of them",
            )
        )  # fmt: skip
    _tree.require(
        lambda: bool(value > 0) and bool(jnp.isfinite(value)),
        f"dvax.vi.Weighted({name})",
        value,
        f"it must be positive and finite: {why}",
        "Leave it out where it is not known",
    )
    return value
