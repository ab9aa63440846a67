"""Second-order cones, as in Coulomb friction."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from ._root import root_in_unit_interval
from ._weights import has_uniform_weight, inverse_weights
from .abstract import AbstractSet


class SecondOrderCone(AbstractSet):
    """K = {y : ‖(y₁, …, yₙ₋₁)‖ ≤ slope · y₀} along the last axis, with the plain 2-norm.

    The first entry is the height, the others are the cross-section. If the slope is a coefficient of
    friction, these are the normal and the tangential force. The other axes of y enumerate cones.
    Without weights the projection onto the surface is explicit, with height
    s = (z₀ + slope‖v‖)/(1 + slope²). With weights w it is xᵢ = wᵢvᵢ(1−θ)/(wᵢ(1−θ) + qθ),
    q = w₀/slope², s = ‖x‖/slope, where θ ∈ (0, 1) is the unique root of
    (1−2θ) ‖x/(1−θ)‖ = slope z₀, computed to roundoff. A point on the surface counts as active. At the
    apex all entries are active, and the derivative is 0.

    **Arguments:** `slope` > 0, a number or an array that broadcasts against the leading axes.

    **Raises:** `dvax.InputError` if the slope is not positive and finite.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.SecondOrderCone()
    >>> K.project(jnp.array([0.0, 2.0, 0.0]), dvax.spaces.Euclidean(3)).tolist()
    [1.0, 1.0, 0.0]

    ```
    """

    slope: jax.Array

    def __init__(self, slope: Any = 1.0):
        name = "dvax.sets.SecondOrderCone(slope)"
        self.slope = _tree.as_array(slope, name)
        _tree.require(
            lambda: np.all((np.asarray(self.slope) > 0) & np.isfinite(self.slope)),
            name,
            self.slope,
            "the slope must be positive and finite, or the cone is a line or a half-space",
            "Use dvax.sets.Box for a line, dvax.sets.HalfSpace for a half-space",
        )
        if not _tree.is_concrete(self.slope):
            # A traced slope: replace one that is not positive by NaN, so that it stops a solve.
            self.slope = jnp.where(self.slope > 0, self.slope, jnp.nan)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        height, across = z[..., 0], z[..., 1:]
        slope = jnp.broadcast_to(self.slope, height.shape)
        length = _length(across)
        inside = length < slope * height
        if has_uniform_weight(space):
            s = (height + slope * length) / (1.0 + slope * slope)
            apex = s <= 0
            divisor = jnp.where(length > 0, length, 1.0)
            scaled = across * (slope * s / divisor)[..., None]
            surface = jnp.concatenate([s[..., None], scaled], -1)
        else:
            w = 1.0 / inverse_weights(space, z)
            w_height, w_across = w[..., 0], w[..., 1:]
            apex = _length(w_across * across) <= -w_height * height / slope
            surface = _weighted_surface(height, across, slope, w_height, w_across, inside | apex)
        # Both comparisons are false for NaN, which therefore propagates from the surface.
        return jnp.where(inside[..., None], z, jnp.where(apex[..., None], 0.0, surface))

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        height, across = z[..., 0], z[..., 1:]
        w = 1.0 / inverse_weights(space, z)
        polar = _length(w[..., 1:] * across) + w[..., 0] * height / self.slope
        return [self.slope * height - _length(across), polar]

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        shape = _tree.shapes(like)
        fits = not isinstance(like, tuple) and len(shape) > 0 and shape[-1] > 1
        if fits:
            try:
                batch = jnp.broadcast_shapes(jnp.shape(self.slope), shape[:-1])
            except ValueError:
                batch = None
            fits = batch == shape[:-1]
        if not fits:
            raise input_error(
                "dvax.sets.SecondOrderCone(slope)",
                f"y = P u of shape {shape} and a slope of shape {jnp.shape(self.slope)}",
                "y must have at least two entries along its last axis, the height first, and "
                "the slope must broadcast against the other axes",
                "Arrange the entries of each cone along the last axis",
            )


def _weighted_surface(
    height: jax.Array,
    across: jax.Array,
    slope: jax.Array,
    w_height: jax.Array,
    w_across: jax.Array,
    unused: jax.Array,
) -> jax.Array:
    """Return the projection onto the surface; finite values, without meaning, where `unused`."""
    # The stationarity conditions with multiplier λ: xᵢ = wᵢvᵢ/(wᵢ + λ) and s = w₀z₀/(w₀ − λ slope²).
    # The substitution λ = qθ/(1 − θ) makes the interval finite and the condition s slope = ‖x‖ free
    # of poles. Each of its factors decreases with θ, so the root is unique.
    across = jnp.where(unused[..., None], 1.0, across)
    height = jnp.where(unused, 0.0, height)
    # Normalise: the terms of the condition are then of order 1 in any units.
    size = jnp.maximum(jnp.max(jnp.abs(across), axis=-1), jnp.abs(slope * height))
    size = jax.lax.stop_gradient(size)
    across, height = across / size[..., None], height / size
    ratio = w_across * (slope * slope / w_height)[..., None]

    def scaled_x(theta: jax.Array) -> jax.Array:
        """x/(1 − θ)."""
        at = theta[..., None]
        return ratio * across / (ratio * (1.0 - at) + at)

    def condition(theta: jax.Array) -> jax.Array:
        return (1.0 - 2.0 * theta) * _length(scaled_x(theta)) - slope * height

    theta = root_in_unit_interval(condition, height)
    x = (1.0 - theta)[..., None] * scaled_x(theta)
    return size[..., None] * jnp.concatenate([(_length(x) / slope)[..., None], x], axis=-1)


def _length(v: jax.Array) -> jax.Array:
    """Return the 2-norm along the last axis, with derivative 0 at 0 and without overflow."""
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(v), axis=-1))
    size = jnp.where(size == 0, 1.0, size)
    square = jnp.sum((v / size[..., None]) ** 2, axis=-1)
    zero = square == 0
    return size * jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square)))
