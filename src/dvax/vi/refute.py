"""Counterexamples to a declared modulus of strong pseudomonotonicity."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..sets import AbstractSet
from ..spaces import AbstractSpace
from .abstract import FrozenVI
from .certificate import certify
from .iteration import first_step, without_derivatives
from .solve import default_space

_ROUNDING_FACTOR = 1e3
"""Assumed rounding error of F, in units of ε times the largest ‖F(y)‖ and L‖y‖."""


class Counterexample(NamedTuple):
    """Two points of K that contradict the modulus γ of F.

    `gamma` is the largest modulus consistent with the pair, below the declared one (0 or less: F is not
    strongly pseudomonotone at all). `why` names the inequality that they violate.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> pair = dvax.vi.refute_gamma(
    ...     lambda y, args: -y, dvax.sets.Box(0.0, 1.0), 0.5, jnp.array([0.0, 0.5, 1.0])
    ... )
    >>> isinstance(pair, dvax.vi.Counterexample), pair.gamma < 0.5
    (True, True)

    ```
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
    """Return two of the points, projected onto K, that contradict the modulus γ of F, or None.

    Sampling can only refute: None says that these points do not contradict γ, and no more. All pairs
    are tested against two statements:

    - the definition: ⟨F(y), z − y⟩ ≥ 0 implies ⟨F(z), z − y⟩ ≥ γ‖z − y‖²;
    - the certificates: with w(y) ∈ F(y) + N_K(y), each point lies within ‖w‖/γ of the unique
      solution, so γ‖y − z‖ ≤ ‖w(y)‖ + ‖w(z)‖ (F continuous). Two different solutions refute every γ.

    Both tests allow for rounding, so that rounding does not refute a true modulus.

    **Arguments:** `F(y, args)`; `K`; `gamma` > 0; `points`, at least two, stacked along a leading
    axis and including all known solutions; `args`; `space`, Euclidean by default. F is evaluated four
    times per point, and N² inner products are formed.

    **Raises:** `dvax.InputError` if there are fewer than two points, or gamma is not positive.

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
    like = _checked_first_point(points, gamma)
    space = default_space(like) if space is None else space
    K.check(like)
    frozen = without_derivatives(FrozenVI(lambda y: F(y, args), K, space))
    definition, certificates = _least_moduli(frozen, points, gamma)
    for pair, why in (
        (definition, "⟨F(y), z − y⟩ ≥ 0, but ⟨F(z), z − y⟩ < γ‖z − y‖²"),
        (certificates, "both nearly solve VI(K, F), but their distance exceeds the bound for γ"),
    ):
        y, z, least = pair
        if float(least) < float(gamma):
            return Counterexample(y, z, float(least), why)
    return None


def _least_moduli(
    vi: FrozenVI, points: Tree, gamma: Any
) -> tuple[tuple[Tree, Tree, jax.Array], tuple[Tree, Tree, jax.Array]]:
    """Return, for each statement, the pair with the smallest admissible modulus, and that modulus."""
    K, space, norm = vi.K, vi.space, vi.space.norm
    ys = jax.vmap(lambda p: K.project(p, space))(points)
    Fs = jax.vmap(vi.F)(ys)
    eps = jnp.finfo(jnp.result_type(*jtu.tree_leaves(ys))).eps
    farthest, taus = jnp.max(jax.vmap(norm)(ys)), jax.vmap(partial(first_step, vi))(ys, Fs)
    # If all points are solutions, F is small there, but the terms that cancel in F are not.
    magnitude = jnp.max(jax.vmap(norm)(Fs)) + jnp.max(1.0 / taus) * (1.0 + farthest)

    def certificate_at(y: Tree, tau: jax.Array) -> tuple[Tree, jax.Array]:
        checked = certify(vi.F, K, space, y, tau)
        return checked.y, checked.norm + _ROUNDING_FACTOR * eps * (magnitude + farthest / tau)

    ybars, ws = jax.vmap(certificate_at)(ys, taus)

    def distance(y: Tree, z: Tree) -> jax.Array:
        return norm(_tree.sub(z, y))

    def work(Fy: Tree, y: Tree, z: Tree) -> jax.Array:
        return space.inner(Fy, _tree.sub(z, y))

    distances, works = _pairwise(distance, (ys,), ys), _pairwise(work, (Fs, ys), ys)
    tolerance = _ROUNDING_FACTOR * eps * (magnitude + gamma * distances) * (distances + farthest)
    holds = (works > tolerance) & (distances > 0)
    square = jnp.where(holds, distances, 1.0) ** 2
    # works.T is −⟨F(z), z − y⟩.
    by_definition = jnp.where(holds, (tolerance - works.T) / square, jnp.inf)

    distances = _pairwise(distance, (ybars,), ybars)
    different = distances > 0
    sums = ws[:, None] + ws[None, :]
    by_certificates = jnp.where(different, sums / jnp.where(different, distances, 1.0), jnp.inf)
    return _pair_of(ys, by_definition), _pair_of(ybars, by_certificates)


def _pairwise(fn: Callable[..., jax.Array], rows: tuple[Tree, ...], columns: Tree) -> jax.Array:
    """Return the matrix fn(*rowsᵢ, columnsⱼ), computed row by row."""
    each = jax.vmap(fn, in_axes=(None,) * len(rows) + (0,))
    return jax.lax.map(lambda row: each(*row, columns), rows)


def _pair_of(points: Tree, moduli: jax.Array) -> tuple[Tree, Tree, jax.Array]:
    # A NaN is not a counterexample.
    moduli = jnp.where(jnp.isnan(moduli), jnp.inf, moduli)
    i, j = jnp.unravel_index(jnp.argmin(moduli), moduli.shape)
    y, z = (jtu.tree_map(lambda leaf, k=k: leaf[k], points) for k in (i, j))
    return y, z, moduli[i, j]


def _checked_first_point(points: Tree, gamma: Any) -> Tree:
    name = "dvax.vi.refute_gamma"
    counts = {jnp.shape(leaf)[:1] for leaf in jtu.tree_leaves(points)}
    if len(counts) != 1 or (count := counts.pop()) == () or count[0] < 2:
        raise input_error(
            f"{name}(points)",
            f"leaves of shape {_tree.shapes(points)}",
            "at least two points are needed, stacked along the first axis of each leaf",
            "Stack them: jnp.stack([y, z, ...])",
        )
    _tree.require(
        lambda: bool(gamma > 0),
        f"{name}(gamma)",
        gamma,
        "a modulus of strong pseudomonotonicity is positive",
        "Pass the declared modulus",
    )
    return jtu.tree_map(lambda leaf: leaf[0], points)
