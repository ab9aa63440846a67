"""Generators with complex spectrum, for pairs of real arrays."""

from typing import Any

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from ..spaces import Product as ProductSpace
from .abstract import AbstractPropagator, FlowStep, Growth
from .phi import flow_factors, phi_scalar
from .spectral_state import AbstractModal, coefficients_of, in_form_of, with_coefficients
from .transforms import Transform, times


class Rotation(AbstractModal):
    """A (q, p) = (a q − b p, b q + a p): z = q + ip rotates at the rate b and grows at the rate a.

    A acts on each entry, or on each mode of a transform. Its spectrum is a ± ib. For a = 0 it is
    skew-adjoint, and e^{tA} conserves ‖q‖² + ‖p‖². Schrödinger's equation iψ' = −Δψ has ψ = q + ip and
    the eigenvalues of Δ as b. The wave equation w'' = Δw has b = −√(−Δ), q = √(−Δ) w and p = w', and
    its squared norm is the energy. M = 1 and ω = max a if q and p have the same weights, and, with a
    transform, all points of the grid as well.

    **Arguments:** `growth` = a and `turn` = b, real, in 1/time, of the shape of q and p, or of the
    coefficients of `transform`. For the modes of a `dvax.generators.Elliptic`, use its `symbol` and
    pass its `transform`.

    **Raises:** `dvax.InputError` if the shapes of a and b differ.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> A = dvax.generators.Rotation(jnp.array(0.0), jnp.array(jnp.pi / 2))
    >>> q, p = A.semigroup(1.0, (jnp.array(1.0), jnp.array(0.0)))   # a quarter turn
    >>> print(f"{abs(float(q)):.3f} {float(p):.3f}")
    0.000 1.000

    ```
    """

    a: jax.Array
    b: jax.Array
    transform: Transform | None

    def __init__(self, growth: Any, turn: Any, transform: Transform | None = None):
        self.a = _tree.as_array(growth, "dvax.generators.Rotation(growth)")
        self.b = _tree.as_array(turn, "dvax.generators.Rotation(turn)")
        self.transform = transform
        if self.a.ndim == 0 and self.b.ndim > 0:
            self.a = jnp.broadcast_to(self.a, self.b.shape)
        if self.a.shape != self.b.shape:
            raise input_error(
                "dvax.generators.Rotation(growth, turn)",
                f"shapes {self.a.shape} and {self.b.shape}",
                "both must have the same shape",
                "Give both the same shape, or growth as a number",
            )

    def apply(self, v: Tree) -> Tree:
        return self.backward(_multiply(self.a, self.b, self.forward(v)))

    def expand(self, v: Tree, coefficients: Tree = None) -> Tree:
        if self.transform is None:
            return v
        return with_coefficients(v, coefficients, self.forward)

    def propagator(self, h: Any, terms: int) -> "RotationPropagator":
        z = jax.lax.complex(h * self.a, h * self.b)
        factors = flow_factors(jnp.asarray(h).astype(z.dtype), phi_scalar(z, terms))
        return RotationPropagator(self, factors)

    def check(self, space: AbstractSpace) -> None:
        zeros = space.like()
        _tree.fits_parts("dvax.generators.Rotation", 2, zeros, "state space")
        shape = self.b.shape if self.transform is None else self.transform.shape
        like = jax.ShapeDtypeStruct(shape, self.b.dtype)
        for part in zeros:
            _tree.fits("dvax.generators.Rotation", like, part, "state space, part by part")

    def adjoint(self, space: AbstractSpace) -> "Rotation":
        weight_ratio = self.growth(space).M
        _tree.require(
            lambda: float(weight_ratio) <= 1.0 + 1e-12,
            "dvax.generators.Rotation.adjoint(space)", weight_ratio,
            "q and p, and all points of the grid, must have the same weight, or A* is no Rotation",
            "Use a space with one weight for all points",
        )  # fmt: skip
        return Rotation(self.a, -self.b, self.transform)

    def growth(self, space: AbstractSpace) -> Growth:
        parts = space.spaces if isinstance(space, ProductSpace) else (space, space)
        first, second = (part.weights() for part in parts)
        if self.transform is None:
            # Each pair rotates independently, so only the ratio of the weights of q and p matters.
            ratio = first / second
            spread = jnp.maximum(jnp.max(ratio), jnp.max(1.0 / ratio))
        else:
            low = jnp.minimum(jnp.min(first), jnp.min(second))
            spread = jnp.maximum(jnp.max(first), jnp.max(second)) / low
        return Growth(jnp.sqrt(spread), jnp.max(self.a))

    def chord_deviation(self, step: FlowStep, space: AbstractSpace, growth: Growth) -> Tree:
        # z'' = e^{λ(t−t₀)} z''(t₀) with λ = a + ib.
        h, x0, _, c = step

        def multiply(v: Tree) -> Tree:
            return _multiply(self.a, self.b, v)

        start, constant, *linear = (coefficients_of(v, self.forward) for v in (x0, *c))
        curvature = multiply(_tree.add(multiply(start), constant))
        if linear:
            curvature = _tree.add(curvature, _tree.scale(1.0 / h, linear[0]))
        # |q|² + |p|² is |z|² for real q and p, and at least |z|²/2 for complex coefficients.
        size = jnp.sqrt(sum(jnp.real(v) ** 2 + jnp.imag(v) ** 2 for v in curvature))
        bound = h**2 / 8 * jnp.exp(jnp.maximum(self.a, 0.0) * h) * size
        if self.transform is not None:
            amplitudes = self.transform.amplitudes().astype(bound.dtype)
            bound = jnp.broadcast_to(jnp.sum(amplitudes * bound), self.transform.shape)
        return bound, bound

    def forward(self, v: Tree) -> Tree:
        """Return the coefficients of both parts."""
        return v if self.transform is None else tuple(map(self.transform.forward, v))

    def backward(self, v: Tree) -> Tree:
        """Return the pair with these coefficients."""
        return v if self.transform is None else tuple(map(self.transform.backward, v))


class RotationPropagator(AbstractPropagator):
    """A propagator that multiplies pairs by complex factors."""

    generator: Rotation
    factors: tuple[jax.Array, ...]

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        pairs = [coefficients_of(v, self.generator.forward) for v in (x0, *c)]
        products = [
            _multiply(jnp.real(f), jnp.imag(f), v)
            for f, v in zip(self.factors, pairs, strict=False)
        ]
        total = products[0]
        for product in products[1:]:
            total = _tree.add(total, product)
        return in_form_of(x0, total, self.generator.backward)


def _multiply(a: jax.Array, b: jax.Array, v: Tree) -> Tree:
    """Return (a + ib)(q + ip) as a pair; q and p may be complex coefficients of real fields."""
    q, p = v
    return times(a, q) - times(b, p), times(b, q) + times(a, p)
