"""A declared modulus of strong pseudomonotonicity against the operator itself."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..sets import AbstractSet
from ..spaces import AbstractSpace
from .abstract import Frozen
from .certificate import certify
from .iteration import first_step, stopped
from .solve import default_space

_ROUNDING = 1e3
"""F is taken to be evaluated to so many roundings of the largest F(y) and L‖y‖ at hand."""


class Counterexample(NamedTuple):
    """Two points of K that no F with the modulus γ can have.

    `gamma` is the largest modulus that the pair leaves possible, below the one that was declared
    (0 or less: F is not strongly pseudomonotone at all). `why` says in a sentence what they break.
    """

    y: Tree
    z: Tree
    gamma: float
    why: str


def refute_gamma(
    F: Callable[[Tree, Any], Tree],
    K: AbstractSet,
    gamma: Any,
    points: Tree,
    args: Any = None,
    space: AbstractSpace | None = None,
) -> Counterexample | None:
    """A pair among the points, taken into K, that F cannot have with the modulus γ; else None.

    Sampling can only refute: None says that these points do not contradict γ, and nothing more.
    All pairs are held against two statements:

    - the definition: ⟨F(y), z − y⟩ ≥ 0 implies ⟨F(z), z − y⟩ ≥ γ‖z − y‖²;
    - the certificates: with w(y) ∈ F(y) + N_K(y) both lie within ‖w‖/γ of the one solution, so
      γ‖y − z‖ ≤ ‖w(y)‖ + ‖w(z)‖ (F continuous). Two solutions, found from different guesses,
      refute every γ.

    Both are read with room for rounding, so that a true modulus is not refuted by it.

    **Arguments:** `F(y, args)`; `K`; `gamma` > 0; `points`, at least two, stacked along a leading
    axis, solutions among them wherever there are any; `args`; `space`, Euclidean by default. F is
    evaluated four times a point, and N² inner products are formed.

    **Raises:** `dvax.InputError` where there are fewer than two points, or gamma is not positive.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> F = lambda y, args: (2 + jnp.sin(y)) * y - 5.577190427585528
    >>> K, points = dvax.sets.Box(0.0, 4.71238898038469), jnp.linspace(0.0, 4.7, 20)
    >>> dvax.vi.refute_gamma(F, K, 0.1, points).gamma < 0
    True
    >>> G = lambda y, args: (2 + jnp.sin(y)) * (y - 2.5)
    >>> dvax.vi.refute_gamma(G, K, 1.0, points) is None
    True

    ```
    """
    like = _first_of(points, gamma)
    space = default_space(like) if space is None else space
    K.check(like)
    frozen = stopped(Frozen(lambda y: F(y, args), K, space))
    definition, certificates = _least_moduli(frozen, points, gamma)
    for found, why in (
        (definition, "⟨F(y), z − y⟩ ≥ 0, but ⟨F(z), z − y⟩ < γ‖z − y‖²"),
        (certificates, "both nearly solve VI(K, F), but they lie farther apart than γ allows"),
    ):
        y, z, least = found
        if float(least) < float(gamma):
            return Counterexample(y, z, float(least), why)
    return None


def _least_moduli(
    vi: Frozen, points: Tree, gamma: Any
) -> tuple[tuple[Tree, Tree, jax.Array], tuple[Tree, Tree, jax.Array]]:
    """For each statement the pair that leaves the least modulus possible, and that modulus."""
    K, space, norm = vi.K, vi.space, vi.space.norm
    ys = jax.vmap(lambda p: K.project(p, space))(points)
    Fs = jax.vmap(vi.F)(ys)
    eps = jnp.finfo(jnp.result_type(*jtu.tree_leaves(ys))).eps
    farthest, taus = jnp.max(jax.vmap(norm)(ys)), jax.vmap(partial(first_step, vi))(ys, Fs)
    # Where all points are solutions F is small there, but not the terms that it is made of.
    steepest = jnp.max(jax.vmap(norm)(Fs)) + jnp.max(1.0 / taus) * (1.0 + farthest)

    def certificate(y: Tree, tau: jax.Array) -> tuple[Tree, jax.Array]:
        checked = certify(vi.F, K, space, y, tau)
        return checked.y, checked.norm + _ROUNDING * eps * (steepest + farthest / tau)

    ybars, ws = jax.vmap(certificate)(ys, taus)

    def distance(y: Tree, z: Tree) -> jax.Array:
        return norm(_tree.sub(z, y))

    def push(Fy: Tree, y: Tree, z: Tree) -> jax.Array:
        return space.inner(Fy, _tree.sub(z, y))

    apart, pushes = _pairs(distance, (ys,), ys), _pairs(push, (Fs, ys), ys)
    room = _ROUNDING * eps * (steepest + gamma * apart) * (apart + farthest)
    holds = (pushes > room) & (apart > 0)
    square = jnp.where(holds, apart, 1.0) ** 2
    # ⟨F(z), z − y⟩ is what z pushes away from y, with the other sign.
    by_definition = jnp.where(holds, (room - pushes.T) / square, jnp.inf)

    apart = _pairs(distance, (ybars,), ybars)
    together = ws[:, None] + ws[None, :]
    by_certificates = jnp.where(apart > 0, together / jnp.where(apart > 0, apart, 1.0), jnp.inf)
    return _pair_of(ys, by_definition), _pair_of(ybars, by_certificates)


def _pairs(fn: Callable[..., jax.Array], rows: tuple[Tree, ...], columns: Tree) -> jax.Array:
    """The matrix fn(*rowsᵢ, columnsⱼ), a row at a time."""
    each = jax.vmap(fn, in_axes=(None,) * len(rows) + (0,))
    return jax.lax.map(lambda row: each(*row, columns), rows)


def _pair_of(points: Tree, moduli: jax.Array) -> tuple[Tree, Tree, jax.Array]:
    # NaN is no counterexample.
    moduli = jnp.where(jnp.isnan(moduli), jnp.inf, moduli)
    i, j = jnp.unravel_index(jnp.argmin(moduli), moduli.shape)
    y, z = (jtu.tree_map(lambda leaf, k=k: leaf[k], points) for k in (i, j))
    return y, z, moduli[i, j]


def _first_of(points: Tree, gamma: Any) -> Tree:
    name = "dvax.vi.refute_gamma"
    counts = {jnp.shape(leaf)[:1] for leaf in jtu.tree_leaves(points)}
    if len(counts) != 1 or (count := counts.pop()) == () or count[0] < 2:
        raise InputError(
            InputProblem(
                f"{name}(points)",
                f"leaves of shape {_tree.shapes(points)}",
                "it takes two points to refute a modulus, stacked along the first axis of each leaf",
                "Stack them: jnp.stack([y, z, ...])",
            )
        )
    _tree.require(
        lambda: bool(gamma > 0),
        f"{name}(gamma)",
        gamma,
        "a modulus is positive: there is nothing to refute",
        "Give the modulus that was declared",
    )
    return jtu.tree_map(lambda leaf: leaf[0], points)
