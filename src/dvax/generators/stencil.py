"""Three-point finite differences on a box of equal cells."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax


class Stencil(eqx.Module):
    """Σᵢ aᵢ (v₊ − 2v + v₋) − bᵢ (v₊ − v₋) + r v, where v± are the neighbours along axis i.

    The ghost value beyond a face is the adjacent interior value, with opposite sign for a Dirichlet
    condition. `second` holds aᵢ = dᵢ/h², and `first` holds bᵢ = cᵢ/2h, or None without a velocity.
    """

    boundary: tuple[str, ...] = eqx.field(static=True)
    second: tuple[jax.Array, ...]
    first: tuple[jax.Array | None, ...]
    reaction: jax.Array

    def apply(self, v: jax.Array) -> jax.Array:
        out = self.reaction * v
        for axis, (kind, a, b) in enumerate(
            zip(self.boundary, self.second, self.first, strict=True)
        ):
            left, right = _neighbours(v, axis, kind)
            out = out + a * ((right - v) + (left - v))
            if b is not None:
                out = out - b * (right - left)
        return out

    def adjoint(self) -> "Stencil":
        """Return the stencil with the opposite velocity."""
        return eqx.tree_at(lambda s: s.first, self, jtu.tree_map(jnp.negative, self.first))


def _neighbours(v: jax.Array, axis: int, kind: str) -> tuple[jax.Array, jax.Array]:
    """Return v₋ and v₊ along an axis."""
    n = v.shape[axis]
    first, last = (lax.slice_in_dim(v, k, k + 1, axis=axis) for k in (0, n - 1))
    sign = -1.0 if kind == "dirichlet" else 1.0
    ghosts = (last, first) if kind == "periodic" else (sign * first, sign * last)
    left = lax.concatenate([ghosts[0], lax.slice_in_dim(v, 0, n - 1, axis=axis)], axis)
    right = lax.concatenate([lax.slice_in_dim(v, 1, n, axis=axis), ghosts[1]], axis)
    return left, right
