"""Complex spectrum on pairs of real arrays."""

from typing import Any

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from ..spaces import Product as ProductSpace
from .abstract import AbstractPropagator, Arc, Growth
from .expanded import AbstractModal, as_given, coefficients_of, with_coefficients
from .phi import flow_factors, phi_scalar
from .transforms import Transform, times


class Rotation(AbstractModal):
    """A (q, p) = (a q − b p, b q + a p): z = q + ip turns at the rate b and grows at the rate a, entry
    by entry, or mode by mode of a transform. Its spectrum is a ± ib.

    With a = 0 it is skew: e^{tA} keeps ‖q‖² + ‖p‖². Schrödinger's equation iψ' = −Δψ is b = Δ's
    eigenvalues with ψ = q + ip; the wave equation w'' = Δw is b = −√(−Δ) with q = √(−Δ) w, p = w',
    whose norm is the energy. M = 1 and ω = max a where q and p are weighed alike, and, for modes, all
    points of the grid.

    **Arguments:** `growth` = a and `turn` = b, real, in 1/time, of the shape of q and p, or of the
    coefficients of `transform` (the `symbol` of a `dvax.generators.Elliptic` has it, and its
    `transform` is the one to give).

    **Raises:** `dvax.InputError` where the shapes of a and b differ.

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
            raise InputError(
                InputProblem(
                    "dvax.generators.Rotation(growth, turn)",
                    f"shapes {self.a.shape} and {self.b.shape}",
                    "both act on the same entries",
                    "Give them one shape, or growth as a number",
                )
            )

    def apply(self, v: Tree) -> Tree:
        return self.back(_turned(self.a, self.b, self.there(v)))

    def expand(self, v: Tree, known: Tree = None) -> Tree:
        return v if self.transform is None else with_coefficients(v, known, self.there)

    def propagator(self, h: Any, terms: int) -> "RotationPropagator":
        z = jax.lax.complex(h * self.a, h * self.b)
        factors = flow_factors(jnp.asarray(h).astype(z.dtype), phi_scalar(z, terms))
        return RotationPropagator(self, factors)

    def check(self, space: AbstractSpace) -> None:
        zeros = space.zeros()
        _tree.fits_parts("dvax.generators.Rotation", 2, zeros, "state space")
        shape = self.b.shape if self.transform is None else self.transform.shape
        like = jax.ShapeDtypeStruct(shape, self.b.dtype)
        for part in zeros:
            _tree.fits("dvax.generators.Rotation", like, part, "state space, part by part")

    def adjoint(self, space: AbstractSpace) -> "Rotation":
        alike = self.growth(space).M
        _tree.require(
            lambda: float(alike) <= 1.0 + 1e-12, "dvax.generators.Rotation.adjoint(space)", alike,
            "where q and p, or points of the grid, weigh differently A* is no Rotation",
            "Use a space that weighs them alike",
        )  # fmt: skip
        return Rotation(self.a, -self.b, self.transform)

    def growth(self, space: AbstractSpace) -> Growth:
        parts = space.spaces if isinstance(space, ProductSpace) else (space, space)
        first, second = (part.weights() for part in parts)
        if self.transform is None:
            # Each pair turns by itself, so only what q and p weigh against each other matters.
            ratio = first / second
            spread = jnp.maximum(jnp.max(ratio), jnp.max(1.0 / ratio))
        else:
            low = jnp.minimum(jnp.min(first), jnp.min(second))
            spread = jnp.maximum(jnp.max(first), jnp.max(second)) / low
        return Growth(jnp.sqrt(spread), jnp.max(self.a))

    def bend(self, arc: Arc, space: AbstractSpace, growth: Growth) -> Tree:
        # z'' = e^{λ(t−t₀)} z''(t₀) with λ = a + ib.
        h, x0, _, c = arc
        turn = lambda v: _turned(self.a, self.b, v)  # noqa: E731
        start, first, *rest = (coefficients_of(v, self.there) for v in (x0, *c))
        curvature = turn(_tree.add(turn(start), first))
        if rest:
            curvature = _tree.add(curvature, _tree.scale(1.0 / h, rest[0]))
        # |q|² + |p|² is |z|² where q and p are real, and no less than half of it for complex modes.
        size = jnp.sqrt(sum(jnp.real(v) ** 2 + jnp.imag(v) ** 2 for v in curvature))
        largest = h**2 / 8 * jnp.exp(jnp.maximum(self.a, 0.0) * h) * size
        if self.transform is not None:
            shares = self.transform.shares().astype(largest.dtype)
            largest = jnp.broadcast_to(jnp.sum(shares * largest), self.transform.shape)
        return largest, largest

    def there(self, v: Tree) -> Tree:
        """The coefficients, part by part, that the generator turns."""
        return v if self.transform is None else tuple(map(self.transform.forward, v))

    def back(self, v: Tree) -> Tree:
        """The pair with these coefficients."""
        return v if self.transform is None else tuple(map(self.transform.backward, v))


class RotationPropagator(AbstractPropagator):
    """Complex factors on pairs."""

    generator: Rotation
    factors: tuple[jax.Array, ...]

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        pairs = [coefficients_of(v, self.generator.there) for v in (x0, *c)]
        turned = [
            _turned(jnp.real(f), jnp.imag(f), v) for f, v in zip(self.factors, pairs, strict=False)
        ]
        total = turned[0]
        for other in turned[1:]:
            total = _tree.add(total, other)
        return as_given(x0, total, self.generator.back)


def _turned(a: jax.Array, b: jax.Array, v: Tree) -> Tree:
    """(a + ib)(q + ip) as a pair; q and p may be complex themselves, as coefficients of real fields."""
    q, p = v
    return times(a, q) - times(b, p), times(b, q) + times(a, p)
