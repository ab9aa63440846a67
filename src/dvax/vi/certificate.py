"""Residuals of VI(K, F) and the certified distance to its solution.

Throughout, K is closed convex and F strongly pseudomonotone on K with modulus γ, with solution y*.

C0. Let ȳ ∈ K and w ∈ F(ȳ) + N_K(ȳ). Then ‖ȳ − y*‖ ≤ ‖w‖/γ.
    Proof. n = w − F(ȳ) ∈ N_K(ȳ) gives ⟨F(ȳ), ȳ − y*⟩ ≤ ⟨w, ȳ − y*⟩. y* is the solution, so
        ⟨F(y*), ȳ − y*⟩ ≥ 0, and strong pseudomonotonicity gives ⟨F(ȳ), ȳ − y*⟩ ≥ γ‖ȳ − y*‖². ∎
C1. With r = y − proj_K(y − τF(y)) and F Lipschitz with L_F,
    ‖y − y*‖ ≤ (1 + L_F/γ + 1/(τγ)) ‖r‖ for every y, in K or not.
    Proof. C0 at ȳ = y − r with w = F(ȳ) − F(y) + r/τ, then the triangle inequality. ∎
    For y ∈ K and τ = 1 it is Kim, Vuong and Khanh 2016, Theorem 4.2, the paper's residual bound.

One projection step yields such a pair (ȳ, w): by the optimality condition of the projection,
(y − ȳ)/τ − F(y) ∈ N_K(ȳ).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from .. import _tree
from .._tree import Tree
from ..sets import AbstractSet
from ..spaces import AbstractSpace


class Certificate(NamedTuple):
    """A point y ∈ K with a w ∈ F(y) + N_K(y), which is 0 only at the solution.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K, space = dvax.sets.Box(0.0, 1.0), dvax.spaces.Euclidean(2)
    >>> near = dvax.vi.certify(lambda y: 2.0 * y - 1.0, K, space, jnp.array([0.6, 0.5]), tau=0.25)
    >>> print(near.y, f"{float(near.bound(gamma=2.0)):.3f}")         # the solution is (½, ½)
    [0.55 0.5 ] 0.050

    ```
    """

    y: Tree
    w: Tree
    norm: jax.Array

    def bound(self, gamma: Any) -> jax.Array:
        """Return the bound ‖w‖/γ on ‖y − y*‖ (C0)."""
        return self.norm / gamma


def natural_residual(
    F: Callable[[Tree], Tree], K: AbstractSet, space: AbstractSpace, y: Tree, tau: Any = 1.0
) -> Tree:
    """Return R_τ(y) = y − proj_K(y − τF(y)), which vanishes only at the solution (τ > 0).

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K, space = dvax.sets.Box(0.0, 1.0), dvax.spaces.Euclidean(2)
    >>> R = lambda y: dvax.vi.natural_residual(lambda y: 2.0 * y - 1.0, K, space, y)
    >>> R(jnp.array([0.5, 0.5])).tolist(), R(jnp.array([0.75, 0.5])).tolist()
    ([0.0, 0.0], [0.5, 0.0])

    ```
    """
    return _tree.sub(y, K.project(_tree.sub(y, _tree.scale(tau, F(y))), space))


def certify(
    F: Callable[[Tree], Tree], K: AbstractSet, space: AbstractSpace, y: Tree, tau: Any
) -> Certificate:
    """Return ȳ = proj_K(y − τF(y)) with w = F(ȳ) − F(y) + (y − ȳ)/τ: one projection step from y.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K, space = dvax.sets.Box(0.0, 1.0), dvax.spaces.Euclidean(2)
    >>> near = dvax.vi.certify(lambda y: 2.0 * y - 1.0, K, space, jnp.array([0.6, 0.5]), tau=0.25)
    >>> distance = space.norm(near.y - 0.5)                          # the solution is (½, ½)
    >>> bool(distance <= near.norm / 2.0 + 1e-15)
    True

    ```
    """
    Fy = F(y)
    ybar = K.project(_tree.sub(y, _tree.scale(tau, Fy)), space)
    w = _tree.add(_tree.sub(F(ybar), Fy), _tree.scale(1.0 / tau, _tree.sub(y, ybar)))
    return Certificate(ybar, w, space.norm(w))


def residual_bound(residual_norm: Any, tau: Any, gamma: Any, L_F: Any) -> Any:
    """Return the bound (1 + L_F/γ + 1/(τγ)) ‖R_τ(y)‖ on ‖y − y*‖, for every y (C1).

    ```python
    >>> import dvax
    >>> dvax.vi.residual_bound(1e-6, tau=1.0, gamma=2.0, L_F=2.0)
    2.4999999999999998e-06

    ```
    """
    return (1.0 + L_F / gamma + 1.0 / (tau * gamma)) * residual_norm
