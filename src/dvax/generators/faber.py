"""e^{hA} and its φ-functions by Faber series, which use A only in products Av.

Let E be an ellipse that contains the numerical range of A, with half-axes a and b around z₀. Its Faber
polynomials are F₀ = 1 and Fₖ = 2τₖ, with

    τ₀ = 1,   τ₁ = (z − z₀)/(a + b),   τₖ₊₁ = 2 (z − z₀)/(a + b) τₖ − (a − b)/(a + b) τₖ₋₁,

the Chebyshev polynomials if E is an interval. On the boundary z(w) = z₀ + ½(a + b)w + ½(a − b)/w,
|w| = 1, an analytic g equals Σ ĝₖ wᵏ over all k, and g = Σ_{k≥0} ĝₖ Fₖ inside. One fast Fourier
transform therefore yields the coefficients. Since ‖Fₖ(A)‖ ≤ 2 if E is convex and contains the numerical
range (Beckermann 2005), the truncation error of g(A) is at most twice the sum of the omitted
coefficients, for normal and non-normal A alike. The series is truncated at roundoff. There is no
orthogonalisation and no stored basis. For large h‖A‖ the cost is about √(h‖A‖) products if A is
self-adjoint and h‖A‖ if it is skew-adjoint. The derivative in h is that of the differential equation,
and the derivative in the data of A is that of the polynomial.

Source: Beckermann and Reichel, Error estimates and evaluation of matrix functions via the Faber
transform, SIAM J. Numer. Anal. 47 (2009); the bound: Beckermann, C. R. Acad. Sci. Paris 340 (2005).
"""

import math
from collections.abc import Callable
from functools import partial, reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.custom_derivatives import SymbolicZero

from .. import _tree
from .._batch import largest_of_lanes
from .._tree import Tree
from .abstract import AbstractGenerator, AbstractPropagator
from .bounded_while import bounded_while
from .phi import flow_factors, phi_scalar

_FFT_SIZES = (256, 2048, 16384)
"""Lengths of the Fourier transform that computes the coefficients."""
_MAX_EXPONENT = 4.0
"""The largest real part of hz on the ellipse in one substep."""
_MAX_SUBSTEPS = 256
"""The largest number of substeps; a step that needs more (millions of products) is NaN."""
_TERMS_PER_CHECKPOINT, _LOOP_WIDTHS = 8, (32, 32)
"""Shape of the nested loops over the terms of a series. The reverse pass stores one checkpoint for
every 8 terms."""

_CHECKPOINTS = 64
"""Vectors of the recurrence that a derivative in the data of A stores. Between two of them are at most
128 others, which are computed again."""


class Ellipse(NamedTuple):
    """An ellipse: its centre, and the half-axes along the real and the imaginary axis."""

    centre: Any
    real: Any
    imaginary: Any


class Range(NamedTuple):
    """An enclosure of the numerical range {⟨Av, v⟩ : ‖v‖ = 1}, v complex.

    The rectangle has real parts from `low` to `high` and imaginary parts up to ±`height`. `ellipse`
    is a second enclosure, if there is one. The inner product is Σ `weights`ᵢ aᵢ bᵢ, or one with
    l Σ wᵢaᵢ² ≤ ‖a‖² ≤ l `spread` Σ wᵢaᵢ² for some l. If `proved` is false the enclosure is declared,
    and so are the bounds that depend on it.

    ```python
    >>> import dvax
    >>> region = dvax.generators.Range(-4.0, 0.0, height=1.0)      # −4 ≤ Re ≤ 0, |Im| ≤ 1
    >>> region.low, region.high, region.height, region.proved
    (-4.0, 0.0, 1.0, False)

    ```
    """

    low: Any
    high: Any
    height: Any = 0.0
    weights: Tree = 1.0
    ellipse: Ellipse | None = None
    proved: bool = False
    spread: Any = 1.0


def smaller_ellipse(one: Ellipse, other: Ellipse) -> Ellipse:
    """Return the ellipse of smaller capacity, which is half the sum of the half-axes."""
    return _tree.where(one.real + one.imaginary < other.real + other.imaginary, one, other)


def enclosing_ellipse(enclosure: Range, dtype: Any) -> Ellipse:
    """Return the smaller of the given ellipse and the ellipse of least capacity around the rectangle.

    The ellipse is enlarged by more than roundoff.
    """
    low, high, height = (lax.stop_gradient(jnp.asarray(v, dtype)) for v in enclosure[:3])
    width = 0.5 * (high - low)
    p, q = jnp.cbrt(width) ** 2, jnp.cbrt(height) ** 2
    best = Ellipse(0.5 * (low + high), p * jnp.sqrt(p + q), q * jnp.sqrt(p + q))
    if enclosure.ellipse is not None:
        given = Ellipse(*(lax.stop_gradient(jnp.asarray(v, dtype)) for v in enclosure.ellipse))
        best = smaller_ellipse(given, best)
    # Enlarge by little more than the roundoff of its sides: values with Re z > 0 amplify errors.
    size = jnp.abs(low) + jnp.abs(high) + height
    eps, tiny = jnp.finfo(dtype).eps, jnp.finfo(dtype).tiny
    least = 1e-6 * size + jnp.sqrt(tiny)
    return Ellipse(
        best.centre, jnp.maximum(best.real, least) + 8 * eps * size, best.imaginary * (1 + 8 * eps)
    )


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)


def _linear_in_all(tangents: list[Any]) -> list[jax.Array]:
    """Return the tangents as arrays, each a linear function of all that are not symbolic zeros.

    JAX transposes a linear solve only if it is linear in every part of its right-hand side.
    """
    first = sum(t.reshape(-1)[0] for t in tangents if not _is_zero(t))

    def one(t: Any) -> jax.Array:
        zero = 0.0 * first
        return jnp.broadcast_to(zero, t.shape) if _is_zero(t) else t + zero

    return [one(t) for t in tangents]


def _linear_step(
    with_data: Callable[[list[Any]], "FaberPropagator"], data: list[Any],
    v: tuple[Tree, ...], dv: tuple[Tree, ...], change: list[Any],
) -> Tree:  # fmt: skip
    """Return the change S dv + (dS)v of the flow Sv, v = (x₀, c), for a change of the data of A.

    It is linear in both changes, and so a part of the solution of a triangular system, y − S dv − (dS)v
    = 0, whose transposed solution is written by hand. Loops over the terms that a reverse pass can
    differentiate store every term that there could be, at hundreds of times the cost.
    """

    def apply(step: str, dv: tuple[Tree, ...], change: list[Any]) -> Tree:
        if not change:
            return getattr(with_data(data), step)(dv)
        run = lambda data, v: getattr(with_data(data), step)(v)  # noqa: E731
        return jax.jvp(run, (data, v), (change, dv))[1]

    def residual(system: Any) -> Any:
        dv, change, y = system
        return dv, change, _tree.sub(y, apply("_differentiable_step", dv, change))

    def solve(_: Any, right: Any) -> Any:
        dv, change, y = right
        return dv, change, _tree.add(y, apply("_plain_step", dv, change))

    def solve_transposed(_: Any, right: Any) -> Any:
        dv, change, y = right
        propagator = with_data(data)
        if change:
            of_v, of_data = propagator._transposed_in_data(with_data, data, v, y)
        else:
            of_v, of_data = propagator._transposed_step(y, len(dv) - 1), []
        return tuple(map(_tree.add, dv, of_v)), _tree.add(change, of_data), y

    right = dv, change, _tree.scale(0.0, dv[0])
    return lax.custom_linear_solve(residual, right, solve, solve_transposed)[2]


class FaberPropagator(AbstractPropagator):
    """The flow over `substeps` equal substeps, each a Faber series of degree `degree`.

    `coefficients[i, k]` multiplies Fₖ(A) x₀ (i = 0) or Fₖ(A) cᵢ₋₁. `length` is h. Derivatives are those
    of the flow: in h by its differential equation, in the data of A by the recurrence.
    """

    generator: AbstractGenerator
    ellipse: Ellipse
    coefficients: jax.Array
    degree: jax.Array
    substeps: jax.Array
    length: jax.Array

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        numbers, rest = eqx.partition(self, eqx.is_array)
        leaves, structure = jtu.tree_flatten(numbers)
        of_generator = range(len(jtu.tree_leaves(numbers.generator)))

        def whole(leaves: list[Any]) -> FaberPropagator:
            return eqx.combine(jtu.tree_unflatten(structure, leaves), rest)

        @jax.custom_jvp
        def flow(leaves: list[Any], v: tuple[Tree, ...]) -> Tree:
            return whole(leaves)._plain_step(v)

        def tangent(primals: Any, tangents: Any) -> tuple[Tree, Tree]:
            (leaves, v), (leaf_tangents, v_tangents) = primals, tangents
            # The ellipse is constant, and the coefficients depend on h alone, treated below.
            moving = [k for k in of_generator if not _is_zero(leaf_tangents[k])]

            def with_data(data: list[Any]) -> FaberPropagator:
                changed = dict(zip(moving, data, strict=True))
                return whole([changed.get(k, leaf) for k, leaf in enumerate(leaves)])

            out = flow(leaves, v)
            total = _tree.zeros_like(out)
            parts, dv = jtu.tree_flatten(v_tangents, is_leaf=_is_zero)
            given = [*parts, *(leaf_tangents[k] for k in moving)]
            if not all(map(_is_zero, given)):
                given = _linear_in_all(given)
                dv, change = jtu.tree_unflatten(dv, given[: len(parts)]), given[len(parts) :]
                data = [leaves[k] for k in moving]
                total = _linear_step(with_data, data, v, dv, change)
            of_h = leaf_tangents[-1]
            if not _is_zero(of_h):
                # d/dh = Ax₁ + p(1) − S(0, (j cⱼ))/h, from zφₖ′ = (z − k)φₖ + 1/(k − 1)!.
                propagator, (x, *c) = whole(leaves), v
                rate = reduce(_tree.add, c, propagator.generator.apply(out))
                if len(c) > 1:
                    h, zero = propagator.length, _tree.zeros_like(x)
                    c = tuple(_tree.scale(float(j), one) for j, one in enumerate(c))
                    mean = _tree.scale(1.0 / jnp.where(h == 0, 1.0, h), flow(leaves, (zero, *c)))
                    limit = [_tree.scale(1.0 / (j + 1.0), one) for j, one in enumerate(c)]
                    mean = _tree.where(h == 0, reduce(_tree.add, limit), mean)
                    rate = _tree.sub(rate, mean)
                total = _tree.add(total, _tree.scale(of_h, rate))
            return out, total

        flow.defjvp(tangent, symbolic_zeros=True)
        return flow(leaves, (x0, *c))

    def _substeps(self) -> Any:
        # The lanes of a batch may have propagators of different step sizes.
        return largest_of_lanes(self.substeps)

    def _substep(self, s: Any, x: Tree, c: tuple[Tree, ...], total: Callable) -> Tree:
        dtype = jnp.result_type(*jtu.tree_leaves(x))
        count = jnp.asarray(self.substeps, dtype)
        new = total((x, *_rescaled(s.astype(dtype) / count, 1.0 / count, c)))
        return _tree.where(s < self.substeps, new, x)

    def _differentiable_step(self, v: tuple[Tree, ...]) -> Tree:
        x0, *c = v
        one = lambda s, x: self._substep(s, x, tuple(c), self._sum)  # noqa: E731
        return bounded_while(self._substeps(), one, x0, 1, (_MAX_SUBSTEPS,))

    def _plain_step(self, v: tuple[Tree, ...]) -> Tree:
        x0, *c = v
        one = lambda s, x: self._substep(s, x, tuple(c), self._plain_sum)  # noqa: E731
        return lax.fori_loop(0, self._substeps(), one, x0)

    def _transposed_step(self, y: Tree, terms: int) -> tuple[Tree, ...]:
        """Return Sᵀy, the parts of x₀ and c."""
        sums = lambda s, y: (self._transposed_sum(y, terms + 1), ())  # noqa: E731
        return self._in_reverse(y, terms, (), sums)[0]

    def _transposed_in_data(
        self, with_data: Callable, data: list[Any], v: tuple[Tree, ...], y: Tree
    ) -> tuple[tuple[Tree, ...], list[Any]]:
        """Return Sᵀy, and the product of y with the derivative of Sv in the data of A."""
        x0, *c = v
        count = jnp.asarray(self.substeps, jnp.result_type(*jtu.tree_leaves(y)))
        one = lambda s, x: self._substep(s, x, tuple(c), self._plain_sum)  # noqa: E731

        def sums(s: Any, y: Tree) -> Any:
            # A second pass over the earlier substeps: few steps have more than one.
            x = lax.fori_loop(0, s, one, x0)
            parts = _rescaled(s.astype(count.dtype) / count, 1.0 / count, tuple(c))
            return self._transposed_sum_in_data(with_data, data, (x, *parts), y)

        zero = [jnp.zeros_like(leaf) for leaf in data]
        return self._in_reverse(y, len(c), zero, sums)

    def _in_reverse(self, y: Tree, terms: int, zero: Any, sums: Callable) -> tuple[Any, Any]:
        """Return the parts of x₀ and c, and the sum of what `sums` returns for each substep besides."""
        dtype = jnp.result_type(*jtu.tree_leaves(y))
        count, substeps = jnp.asarray(self.substeps, dtype), self._substeps()

        def substep(k: Any, carry: Any) -> Any:
            y, c, total = carry
            s = substeps - 1 - k
            (x, *parts), found = sums(s, y)
            theta, length = s.astype(dtype) / count, 1.0 / count
            more = tuple(map(_tree.add, c, _rescaled_transposed(theta, length, tuple(parts))))
            return _tree.where(s < self.substeps, (x, more, _tree.add(total, found)), carry)

        start = y, tuple(_tree.zeros_like(y) for _ in range(terms)), zero
        x, c, total = lax.fori_loop(0, substeps, substep, start)
        return (x, *c), total

    def _recurrence(self, dtype: Any) -> tuple[Any, Any, Any, jax.Array]:
        """Return z₀, the two numbers of the recurrence, and the coefficients."""
        z0, a, b = (jnp.asarray(number, dtype) for number in self.ellipse)
        return z0, 2.0 / (a + b), (a - b) / (a + b), self.coefficients.astype(dtype)

    def _clenshaw(self, v: tuple[Tree, ...]) -> tuple[Callable, Callable]:
        """Return the step of Clenshaw's recurrence, and the sum from the last two vectors."""
        z0, forward, back, rows = self._recurrence(jnp.result_type(*jtu.tree_leaves(v)))

        def combined(factor: Any, k: Any, product: Any, first: Tree, second: Tree) -> Tree:
            weights = (1.0 if isinstance(k, int) else 2.0) * rows[:, k]
            return jtu.tree_map(
                lambda Au, u, s, *leaves: sum(map(jnp.multiply, weights, leaves))
                + factor * (Au - z0 * u) - back * s,
                product, first, second, *v,
            )  # fmt: skip

        degree = largest_of_lanes(self.degree)

        def term(j: Any, carry: tuple[Tree, Tree]) -> tuple[Tree, Tree]:
            first, second = carry
            product = self.generator.apply(first)
            return combined(forward, degree - j, product, first, second), first

        def end(first: Tree, second: Tree) -> Tree:
            return combined(0.5 * forward, 0, self.generator.apply(first), first, second)

        return term, end

    def _plain_sum(self, v: tuple[Tree, ...]) -> Tree:
        """Return `_sum(v)` by a loop over the terms alone, which has no reverse derivative."""
        term, end = self._clenshaw(v)
        zero = _tree.zeros_like(v[0])
        return end(*lax.fori_loop(0, largest_of_lanes(self.degree), term, (zero, zero)))

    def _transposed_sum(self, y: Tree, count: int) -> tuple[Tree, ...]:
        """Return Σₖ coefficients[i, k] Fₖ(Aᵀ) y for i < count, with the transposed products of A."""
        z0, forward, back, rows = self._recurrence(jnp.result_type(*jtu.tree_leaves(y)))
        transpose = jax.vjp(self.generator.apply, y)[1]

        def shifted_product(u: Tree) -> Tree:
            return jtu.tree_map(lambda Au, u: Au - z0 * u, transpose(u)[0], u)

        def scaled(factor: Any, u: Tree) -> Tree:
            return jtu.tree_map(lambda leaf: factor * leaf, u)

        def term(k: Any, carry: tuple[Tree, Tree, tuple[Tree, ...]]) -> Any:
            tau, before, sums = carry
            weights = 2.0 * rows[:, k]
            sums = tuple(_tree.add(s, scaled(weights[i], tau)) for i, s in enumerate(sums))
            new = jtu.tree_map(lambda m, b: forward * m - back * b, shifted_product(tau), before)
            return new, tau, sums

        sums = tuple(scaled(rows[i, 0], y) for i in range(count))
        start = scaled(0.5 * forward, shifted_product(y)), y, sums
        return lax.fori_loop(1, largest_of_lanes(self.degree) + 1, term, start)[2]

    def _transposed_sum_in_data(
        self, with_data: Callable, data: list[Any], v: tuple[Tree, ...], y: Tree
    ) -> tuple[tuple[Tree, ...], list[Any]]:
        """Return `_transposed_sum(y)`, and the product of y with the derivative of the sum in the data.

        The reverse pass meets the vectors of Clenshaw's recurrence from the last to the first. Some
        are stored, and those between two of them are computed again when it arrives there.
        """
        z0, forward, back, rows = self._recurrence(jnp.result_type(*jtu.tree_leaves(y)))
        term, _ = self._clenshaw(v)
        degree, zero = largest_of_lanes(self.degree), _tree.zeros_like(v[0])
        length = jnp.maximum(-(-degree // _CHECKPOINTS), 1)
        longest = -(-(_FFT_SIZES[-1] // 2) // _CHECKPOINTS)
        chunks = -(-degree // length)

        def room(count: int, tree: Tree) -> Tree:
            return jtu.tree_map(lambda leaf: jnp.zeros((count, *leaf.shape), leaf.dtype), tree)

        def row(table: Tree, k: Any) -> Tree:
            take = lambda leaf: lax.dynamic_index_in_dim(leaf, k, 0, False)  # noqa: E731
            return jtu.tree_map(take, table)

        def ends(q: Any) -> tuple[Any, Any]:
            return q * length, jnp.minimum((q + 1) * length, degree)

        def advance(q: Any, state: Any) -> Any:
            carry, stored = state
            return lax.fori_loop(*ends(q), term, carry), _tree.put(stored, q, carry)

        start = (zero, zero), room(_CHECKPOINTS, (zero, zero))
        (first, _), stored = lax.fori_loop(0, chunks, advance, start)

        def pull(at: Tree, factor: Any, u: Tree) -> tuple[list[Any], Tree]:
            """Return the parts of the data and of `at` in factor ⟨u, (A − z₀) at⟩."""
            u = jtu.tree_map(lambda leaf: factor * leaf, u)
            product = lambda data, at: with_data(data).generator.apply(at)  # noqa: E731
            of_data, of_vector = jax.vjp(product, data, at)[1](u)
            return of_data, jtu.tree_map(lambda Au, u: Au - z0 * u, of_vector, u)

        def back_one(k: Any, at: Tree, state: Any) -> Any:
            tau, before, sums, total = state
            weights = 2.0 * rows[:, k]
            sums = tuple(
                jtu.tree_map(lambda s, u, w=weights[i]: s + w * u, one, tau)
                for i, one in enumerate(sums)
            )
            found, product = pull(at, forward, tau)
            new = jtu.tree_map(lambda m, b: m - back * b, product, before)
            return new, tau, sums, _tree.add(total, found)

        def chunk(q: Any, state: Any) -> Any:
            (begin, end), (table, state) = ends(chunks - 1 - q), state

            def again(j: Any, carry: Any) -> Any:
                carry, table = carry
                return term(j, carry), _tree.put(table, j - begin, carry[0])

            given = row(stored, chunks - 1 - q), table
            _, table = lax.fori_loop(begin, end, again, given)

            def one(i: Any, state: Any) -> Any:
                j = end - 1 - i
                return back_one(degree - j, row(table, j - begin), state)

            return table, lax.fori_loop(0, end - begin, one, state)

        total, tau = pull(first, 0.5 * forward, y)
        sums = tuple(jtu.tree_map(lambda leaf, w=w: w * leaf, y) for w in rows[: len(v), 0])
        # One table for all chunks: to clear one for each took half of the time.
        start = room(longest, zero), (tau, y, sums, total)
        _, (_, _, sums, total) = lax.fori_loop(0, chunks, chunk, start)
        return sums, total

    def _sum(self, v: tuple[Tree, ...]) -> Tree:
        """Return Σₖ Fₖ(A) Σᵢ coefficients[i, k] vᵢ by Clenshaw's recurrence."""
        dtype = jnp.result_type(*jtu.tree_leaves(v))
        z0, a, b = (jnp.asarray(number, dtype) for number in self.ellipse)
        rows = self.coefficients.astype(dtype)
        forward, back = 2.0 / (a + b), (a - b) / (a + b)

        def shifted_product(u: Tree) -> Tree:
            return jtu.tree_map(lambda Au, u: Au - z0 * u, self.generator.apply(u), u)

        def term(k: Any, factor: float) -> Tree:
            weights = factor * rows[:, k]
            return jtu.tree_map(lambda *leaves: sum(map(jnp.multiply, weights, leaves)), *v)

        def recurrence(j: Any, carry: tuple[Tree, Tree]) -> tuple[Tree, Tree]:
            first, second = carry
            k = last - j
            new = jtu.tree_map(
                lambda g, m, s: g + forward * m - back * s,
                term(k, 2.0),
                shifted_product(first),
                second,
            )
            return new, first

        # Round the number of terms up: the coefficients beyond the degree are zero.
        degree = largest_of_lanes(self.degree)
        last = -(-degree // _TERMS_PER_CHECKPOINT) * _TERMS_PER_CHECKPOINT
        zero = _tree.zeros_like(v[0])
        first, second = bounded_while(
            degree, recurrence, (zero, zero), _TERMS_PER_CHECKPOINT, _LOOP_WIDTHS
        )
        return jtu.tree_map(
            lambda g, m, s: g + 0.5 * forward * m - back * s,
            term(0, 1.0),
            shifted_product(first),
            second,
        )


def faber_propagator(
    A: AbstractGenerator, enclosure: Range, h: jax.Array, terms: int
) -> FaberPropagator:
    """Return the flow over h for polynomials with up to `terms` coefficients."""
    ellipse, dtype = enclosing_ellipse(enclosure, h.dtype), h.dtype
    z0, a, b = ellipse
    length = lax.stop_gradient(h)
    # |e^{hz}| on the ellipse amplifies roundoff, so its exponent is limited in each substep.
    growth_rate = jnp.maximum(z0 + a, 0.0)
    max_degree = _FFT_SIZES[-1] / 2.2
    # If the largest transform is too short, use s substeps with hb/s + 9√(ha/s) = m, which is a
    # quadratic equation in 1/√s.
    m = 0.95 * max_degree - 260.0
    bump_width, phase = 9.0 * jnp.sqrt(length * a), length * b
    split = ((bump_width + jnp.sqrt(bump_width**2 + 4.0 * phase * m)) / (2.0 * m)) ** 2
    split = jnp.where(_degree_bound(length, a, b) > max_degree, split, 1.0)
    count = jnp.ceil(jnp.maximum(split, length * growth_rate / _MAX_EXPONENT))
    # The comparison is false for NaN, for which nothing is computed; each lane decides for itself.
    fits = count <= _MAX_SUBSTEPS
    substeps = largest_of_lanes(jnp.where(fits, count, 1.0).astype(int))
    part = jnp.where(fits, h, jnp.nan) / substeps.astype(h.dtype)
    needed = 2.2 * _degree_bound(lax.stop_gradient(part), a, b)
    size = jnp.searchsorted(jnp.asarray(_FFT_SIZES[:-1], needed.dtype), needed)

    def series(n: int, part: jax.Array) -> jax.Array:
        angle = jnp.arange(n // 2 + 1, dtype=dtype) * (2 * math.pi / n)
        # Measured from the right end, where e^{hz} is largest: z0 + a cos has an error of ε‖A‖.
        real = (z0 + a) - 2.0 * a * jnp.sin(0.5 * angle) ** 2
        z = lax.complex(part * real, part * b * jnp.sin(angle))
        values = flow_factors(part.astype(z.dtype), phi_scalar(z, terms))
        rows = jnp.stack([jnp.fft.irfft(jnp.conj(value), n)[: n // 2] for value in values])
        return jnp.pad(rows, ((0, 0), (0, _FFT_SIZES[-1] // 2 - n // 2)))

    rows = lax.switch(largest_of_lanes(size), [partial(series, n) for n in _FFT_SIZES], part)
    scale = jnp.sum(jnp.abs(rows), axis=1, keepdims=True)
    above_roundoff = lax.stop_gradient(jnp.abs(rows) > jnp.finfo(dtype).eps * scale)
    order = jnp.arange(rows.shape[1])
    degree = largest_of_lanes(jnp.max(jnp.where(above_roundoff, order, 0)))
    return FaberPropagator(A, ellipse, jnp.where(order <= degree, rows, 0.0), degree, substeps, h)


def _degree_bound(h: Any, a: Any, b: Any) -> Any:
    """Return an upper bound on the degree that e^{hz} requires.

    On the boundary e^{hz} is a bump of width 1/√(ha) with hb oscillations; its coefficients decay
    over a range of ∛(hb) beyond that.
    """
    return h * b + 12.0 * jnp.cbrt(h * b) + 9.0 * jnp.sqrt(h * a) + 30.0


def _rescaled(theta: Any, length: Any, c: tuple[Tree, ...]) -> tuple[Tree, ...]:
    """Return the coefficients in s of p(θ + ls): Σⱼ lʲ Σᵢ (i over j) θ^{i−j} cᵢ sʲ."""
    powers = [theta**k for k in range(len(c))]

    def coefficient(j: int) -> Tree:
        factors = [length**j * math.comb(i, j) * powers[i - j] for i in range(j, len(c))]
        return jtu.tree_map(lambda *leaves: sum(map(jnp.multiply, factors, leaves)), *c[j:])

    return tuple(map(coefficient, range(len(c))))


def _rescaled_transposed(theta: Any, length: Any, w: tuple[Tree, ...]) -> tuple[Tree, ...]:
    """Return the product of the transpose of `_rescaled` with w: Σⱼ (i over j) lʲ θ^{i−j} wⱼ."""
    powers = [theta**k for k in range(len(w))]

    def coefficient(i: int) -> Tree:
        factors = [length**j * math.comb(i, j) * powers[i - j] for j in range(i + 1)]
        return jtu.tree_map(lambda *leaves: sum(map(jnp.multiply, factors, leaves)), *w[: i + 1])

    return tuple(map(coefficient, range(len(w))))
