"""e^{hA} and its φ-functions by Faber series: A is only ever applied.

Let E be an ellipse that contains the numerical range of A, with half-axes a and b around z₀. Its Faber
polynomials are F₀ = 1 and Fₖ = 2τₖ, with

    τ₀ = 1,   τ₁ = (z − z₀)/(a + b),   τₖ₊₁ = 2 (z − z₀)/(a + b) τₖ − (a − b)/(a + b) τₖ₋₁,

Chebyshev's where E is an interval. On its boundary, z(w) = z₀ + ½(a + b)w + ½(a − b)/w for |w| = 1, an
analytic g is Σ ĝₖ wᵏ over all k, and g = Σ_{k≥0} ĝₖ Fₖ inside, so the coefficients come from one fast
Fourier transform. Since ‖Fₖ(A)‖ ≤ 2 wherever E is convex and contains the numerical range (Beckermann
2005), what is left out of g(A) is at most twice the sum of the coefficients left out, for normal and
non-normal A alike: here they are cut where they are no more than rounding. Nothing is orthogonalised or
kept, the cost of h‖A‖ large is √(h‖A‖) products where A is self-adjoint and h‖A‖ where it is skew, and
derivatives are those of a polynomial.

Source: Beckermann and Reichel, Error estimates and evaluation of matrix functions via the Faber
transform, SIAM J. Numer. Anal. 47 (2009); the bound: Beckermann, C. R. Acad. Sci. Paris 340 (2005).
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._batch import largest_of_lanes
from .._tree import Tree
from .abstract import AbstractGenerator, AbstractPropagator
from .phi import flow_factors, phi_scalar
from .turns import turns

_SIZES = (256, 2048, 16384)
"""Of the Fourier transform that finds the coefficients."""
_RISE = 4.0
"""The largest exponent of e^{hz} on the ellipse, in one piece of a step."""
_MOST_PIECES = 256
"""Of a step, beyond which it is not computed but NaN: it would be millions of products."""
_RUN, _BRANCH = 8, (32, 32)
"""The turns of a series, three loops in each other: one that is differentiated backward remembers
where every run began."""


class Ellipse(NamedTuple):
    """Centre, and half-axes along the real axis and along the imaginary one."""

    centre: Any
    real: Any
    imaginary: Any


class Range(NamedTuple):
    """A rectangle that contains the numerical range {⟨Av, v⟩ : ‖v‖ = 1}, v complex: real parts from
    `low` to `high`, imaginary parts up to ± `height`; an `ellipse` that contains it, where one is
    known; in the inner product Σ `weights`ᵢ aᵢ bᵢ, or in one whose squares lie between l and l `spread`
    times Σ `weights`ᵢ aᵢ². Unless it is `proved` it is somebody's word, and so are the bounds that
    rest on it."""

    low: Any
    high: Any
    height: Any = 0.0
    weights: Tree = 1.0
    ellipse: Ellipse | None = None
    proved: bool = False
    spread: Any = 1.0


def smaller(one: Ellipse, other: Ellipse) -> Ellipse:
    """Which of the two is of less capacity, half the sum of the half-axes."""
    return _tree.where(one.real + one.imaginary < other.real + other.imaginary, one, other)


def around(found: Range, dtype: Any) -> Ellipse:
    """The ellipse that is known, or that of least capacity around the rectangle, whichever has the
    shorter axes; widened by more than rounding."""
    low, high, height = (lax.stop_gradient(jnp.asarray(v, dtype)) for v in found[:3])
    width = 0.5 * (high - low)
    p, q = jnp.cbrt(width) ** 2, jnp.cbrt(height) ** 2
    best = Ellipse(0.5 * (low + high), p * jnp.sqrt(p + q), q * jnp.sqrt(p + q))
    if found.ellipse is not None:
        known = Ellipse(*(lax.stop_gradient(jnp.asarray(v, dtype)) for v in found.ellipse))
        best = smaller(known, best)
    # Wider by more than the rounding of its own sides, and no more: what lies right of 0 grows.
    size = jnp.abs(low) + jnp.abs(high) + height
    eps, tiny = jnp.finfo(dtype).eps, jnp.finfo(dtype).tiny
    least = 1e-6 * size + jnp.sqrt(tiny)
    return Ellipse(
        best.centre, jnp.maximum(best.real, least) + 8 * eps * size, best.imaginary * (1 + 8 * eps)
    )


class FaberPropagator(AbstractPropagator):
    """x(h) in `pieces` equal ones, each the sum of a series of `degree`: `coefficients[i, k]` belongs
    to Fₖ and to x₀ (i = 0) or cᵢ₋₁."""

    generator: AbstractGenerator
    ellipse: Ellipse
    coefficients: jax.Array
    degree: jax.Array
    pieces: jax.Array

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        def piece(s: Any, x: Tree) -> Tree:
            dtype = jnp.result_type(*jtu.tree_leaves(x))
            count = self.pieces.astype(dtype)
            new = self._sum((x, *_from(s.astype(dtype) / count, 1.0 / count, c)))
            return _tree.where(s < self.pieces, new, x)

        # Lanes of a batch may have kept propagators of different steps.
        return turns(largest_of_lanes(self.pieces), piece, x0, 1, (_MOST_PIECES,))

    def _sum(self, v: tuple[Tree, ...]) -> Tree:
        """Σₖ Fₖ(A) Σᵢ coefficients[i, k] vᵢ, by Clenshaw's recurrence."""
        dtype = jnp.result_type(*jtu.tree_leaves(v))
        z0, a, b = (number.astype(dtype) for number in self.ellipse)
        rows = self.coefficients.astype(dtype)
        forward, back = 2.0 / (a + b), (a - b) / (a + b)

        def moved(u: Tree) -> Tree:
            return jtu.tree_map(lambda Au, u: Au - z0 * u, self.generator.apply(u), u)

        def mixed(k: Any, factor: float) -> Tree:
            weights = factor * rows[:, k]
            return jtu.tree_map(lambda *leaves: sum(map(jnp.multiply, weights, leaves)), *v)

        def turn(j: Any, carry: tuple[Tree, Tree]) -> tuple[Tree, Tree]:
            first, second = carry
            k = last - j
            new = jtu.tree_map(
                lambda g, m, s: g + forward * m - back * s, mixed(k, 2.0), moved(first), second
            )
            return new, first

        # Whole runs of turns: the coefficients beyond the degree are zero.
        degree = largest_of_lanes(self.degree)
        last = -(-degree // _RUN) * _RUN
        zero = _tree.zeros_like(v[0])
        first, second = turns(degree, turn, (zero, zero), _RUN, _BRANCH)
        return jtu.tree_map(
            lambda g, m, s: g + 0.5 * forward * m - back * s, mixed(0, 1.0), moved(first), second
        )


def propagator(A: AbstractGenerator, found: Range, h: jax.Array, terms: int) -> FaberPropagator:
    """The flow over h."""
    ellipse, dtype = around(found, h.dtype), h.dtype
    z0, a, b = ellipse
    length = lax.stop_gradient(h)
    # As large as e^{hz} is on the ellipse, so many digits of x₀ are lost where x(h) is no larger.
    rise = jnp.maximum(z0 + a, 0.0)
    largest = _SIZES[-1] / 2.2
    # Where one transform is too short, s pieces with hb/s + 9√(ha/s) = m, a quadratic in 1/√s.
    room = 0.95 * largest - 260.0
    bump, turned = 9.0 * jnp.sqrt(length * a), length * b
    split = ((bump + jnp.sqrt(bump**2 + 4.0 * turned * room)) / (2.0 * room)) ** 2
    split = jnp.where(_long(length, a, b) > largest, split, 1.0)
    count = jnp.ceil(jnp.maximum(split, length * rise / _RISE))
    # What is not a number is not computed either, and each lane of a batch answers for itself.
    fits = count <= _MOST_PIECES
    pieces = largest_of_lanes(jnp.where(fits, count, 1.0).astype(int))
    part = jnp.where(fits, h, jnp.nan) / pieces.astype(h.dtype)
    needed = 2.2 * _long(lax.stop_gradient(part), a, b)
    size = jnp.searchsorted(jnp.asarray(_SIZES[:-1], needed.dtype), needed)

    def series(n: int, part: jax.Array) -> jax.Array:
        angle = jnp.arange(n // 2 + 1, dtype=dtype) * (2 * math.pi / n)
        # Measured from the right end, where e^{hz} is not small: z0 + a cos would be off by ε‖A‖.
        real = (z0 + a) - 2.0 * a * jnp.sin(0.5 * angle) ** 2
        z = lax.complex(part * real, part * b * jnp.sin(angle))
        values = flow_factors(part.astype(z.dtype), phi_scalar(z, terms))
        rows = jnp.stack([jnp.fft.irfft(jnp.conj(value), n)[: n // 2] for value in values])
        return jnp.pad(rows, ((0, 0), (0, _SIZES[-1] // 2 - n // 2)))

    rows = lax.switch(largest_of_lanes(size), [partial(series, n) for n in _SIZES], part)
    scale = jnp.sum(jnp.abs(rows), axis=1, keepdims=True)
    matters = lax.stop_gradient(jnp.abs(rows) > jnp.finfo(dtype).eps * scale)
    order = jnp.arange(rows.shape[1])
    degree = largest_of_lanes(jnp.max(jnp.where(matters, order, 0)))
    return FaberPropagator(A, ellipse, jnp.where(order <= degree, rows, 0.0), degree, pieces)


def _long(h: Any, a: Any, b: Any) -> Any:
    """More than the degree that e^{hz} needs: on the boundary it is a bump as wide as 1/√(ha), turned
    hb times, with a tail of the third root of that."""
    return h * b + 12.0 * jnp.cbrt(h * b) + 9.0 * jnp.sqrt(h * a) + 30.0


def _from(theta: Any, length: Any, c: tuple[Tree, ...]) -> tuple[Tree, ...]:
    """The polynomial from θ on, over a piece of length l: Σⱼ lʲ Σᵢ (i over j) θ^{i−j} cᵢ sʲ."""
    powers = [theta**k for k in range(len(c))]

    def coefficient(j: int) -> Tree:
        factors = [length**j * math.comb(i, j) * powers[i - j] for i in range(j, len(c))]
        return jtu.tree_map(lambda *leaves: sum(map(jnp.multiply, factors, leaves)), *c[j:])

    return tuple(map(coefficient, range(len(c))))
