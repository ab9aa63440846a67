"""Three-point formulas on a box of equal cells."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax


class Stencil(eqx.Module):
    """Σᵢ aᵢ (v₊ − 2v + v₋) − bᵢ (v₊ − v₋) + r v, where v± are the neighbours along axis i: what lies
    beyond a face is the value before it, with its sign changed where the field is zero on the face.

    `second` holds the aᵢ = dᵢ/h², `first` the bᵢ = cᵢ/2h, None for an axis without a velocity.
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
            before, behind = _neighbours(v, axis, kind)
            out = out + a * ((behind - v) + (before - v))
            if b is not None:
                out = out - b * (behind - before)
        return out

    def adjoint(self) -> "Stencil":
        """With the velocity turned round."""
        return eqx.tree_at(lambda s: s.first, self, jtu.tree_map(jnp.negative, self.first))


def _neighbours(v: jax.Array, axis: int, kind: str) -> tuple[jax.Array, jax.Array]:
    """v₋ and v₊."""
    n = v.shape[axis]
    first, last = (lax.slice_in_dim(v, k, k + 1, axis=axis) for k in (0, n - 1))
    sign = -1.0 if kind == "dirichlet" else 1.0
    beyond = (last, first) if kind == "periodic" else (sign * first, sign * last)
    before = lax.concatenate([beyond[0], lax.slice_in_dim(v, 0, n - 1, axis=axis)], axis)
    behind = lax.concatenate([lax.slice_in_dim(v, 1, n, axis=axis), beyond[1]], axis)
    return before, behind
