"""Fast transforms to the eigenfunctions of operators with constant coefficients on a box.

Along an axis of n cells of width h the points are the midpoints (j + ½)h of the cells. The
eigenfunctions are

- "periodic": e^{2πikx/L}, by the complex or the real Fourier transform;
- "neumann" (no flux through the ends): cos(kπx/L), k = 0, …, n − 1;
- "dirichlet" (zero at the ends): sin(kπx/L), k = n, …, 1, in this order.

The cosine transform is that of J. Makhoul, A fast cosine transform in one and two dimensions, IEEE
Trans. Acoust. Speech Signal Process. 28 (1980). With the even points followed by the odd points in
reverse order, v = (x₀, x₂, …, x₃, x₁), and the Fourier transform F of v,

    Σⱼ 2xⱼ cos(kπ(j + ½)/n) = aₖFₖ + āₖF₋ₖ,    aₖ = e^{−iπk/2n},

so one transform of n numbers suffices. For real x the right side is 2 Re(aₖFₖ), and −2 Im(aₖFₖ) is the
value at n − k. With every odd xⱼ negated the same formula yields the sine transform at n − k. A
single short axis is transformed by a product with a dense matrix.
"""

import functools
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .layout import WHOLE, Layout, Move, padded
from .line import dct, idct, irfft, rfft

_MAX_DENSE_POINTS = 128
"""Number of points up to which a transform is a product with a dense matrix."""

BOUNDARIES = ("periodic", "dirichlet", "neumann")


class Transform(eqx.Module):
    """The transform of real arrays of a given shape, by `boundary` along each axis, and its inverse.

    Coefficients are real if no axis is periodic. Otherwise they are complex, and only half of them is
    stored along the last periodic axis, since the others are their conjugates.
    """

    shape: tuple[int, ...] = eqx.field(static=True)
    boundary: tuple[str, ...] = eqx.field(static=True)
    layout: Layout | None = eqx.field(static=True, default=None)

    @property
    def half(self) -> int:
        """The axis with the real Fourier transform."""
        periodic = [k for k, kind in enumerate(self.boundary) if kind == "periodic"]
        return periodic[-1] if periodic else len(self.shape) - 1

    @property
    def real(self) -> bool:
        """Whether the coefficients are real."""
        return "periodic" not in self.boundary

    def modes(self, axis: int) -> np.ndarray:
        """Return the mode numbers k along an axis, in the order of the coefficients.

        They count periods over a periodic axis, and half periods over the others."""
        n = self.shape[axis]
        if self.boundary[axis] == "neumann":
            return np.arange(n)
        if self.boundary[axis] == "dirichlet":
            return n - np.arange(n)
        signed = np.fft.rfftfreq(n) if axis == self.half else np.fft.fftfreq(n)
        return np.round(signed * n).astype(int)

    def amplitudes(self) -> jax.Array:
        """Return the maximum absolute value, in real space, of each mode with coefficient 1."""
        out = np.ones(())
        for axis, (n, kind) in enumerate(zip(self.shape, self.boundary, strict=True)):
            k = self.modes(axis)
            if kind == "periodic":
                amplitude = np.where((axis == self.half) & (k > 0) & (2 * k != n), 2.0, 1.0) / n
            else:
                amplitude = np.where((k == 0) | (k == n), 0.5, 1.0) / n
            out = out * along(amplitude, axis, len(self.shape))
        return jnp.asarray(out)

    def forward(self, x: jax.Array) -> jax.Array:
        """Return the coefficients of x."""
        if self.layout is None:
            return self._forward(x)
        if len(self.shape) == 1:
            return self.layout.locally(self._forward, x, WHOLE)
        for move in self._moves():
            x = padded(x, move.shape)
            x = self.layout.locally(partial(self._forward_along, axis=move.axis), x, move.spec)
        return x

    def backward(self, c: jax.Array) -> jax.Array:
        """Return the array with these coefficients."""
        if self.layout is None:
            return self._backward(c)
        if len(self.shape) == 1:
            return self.layout.constrain(self.layout.locally(self._backward, c, WHOLE))
        for move in reversed(self._moves()):
            c = self.layout.locally(partial(self._backward_along, axis=move.axis), c, move.spec)
            c = self.layout.constrain(c, move.old_spec)
            c = jax.lax.slice(c, (0,) * c.ndim, move.old_shape)
        return c

    def place(self, c: jax.Array) -> jax.Array:
        """Return factors of the coefficients in the layout in which `forward` returns these: padded by
        zeros to a multiple of the shards."""
        if self.layout is None:
            return c
        if len(self.shape) == 1:
            return self.layout.constrain(c, WHOLE)
        last = self._moves()[-1]
        shape = list(last.shape)
        shape[last.axis] = c.shape[last.axis]
        return self.layout.constrain(padded(c, tuple(shape)), last.spec)

    def _moves(self) -> list[Move]:
        """Return the moves of the shards, one for each axis in the order in which they are transformed:
        of several axes those on one device first."""
        layout = self.layout
        assert layout is not None
        axes = sorted(range(len(self.shape)), key=lambda k: bool(layout.spec[k]))
        if not self.real:
            # The real Fourier transform comes before the complex ones.
            first = min(axes.index(k) for k, v in enumerate(self.boundary) if v == "periodic")
            axes.remove(self.half)
            axes.insert(first, self.half)
        half = {} if self.real else {self.half: self.shape[self.half] // 2 + 1}
        return layout.moves(self.shape, [(k, half.get(k, self.shape[k])) for k in axes])

    def _forward_along(self, x: jax.Array, axis: int) -> jax.Array:
        """Return the coefficients along one axis, real for real x unless the axis is periodic."""
        kind = self.boundary[axis]
        if kind == "periodic":
            return (jnp.fft.rfft if axis == self.half else jnp.fft.fft)(x, axis=axis)
        x = _fold(x, axis, kind)
        if jnp.iscomplexobj(x):
            F = jnp.fft.fft(x, axis=axis)
            a = self._phase_factors(axis, F.dtype)
            return a * F + jnp.conj(a) * _reflect(F, axis, F)
        return self._cosines(jnp.fft.rfft(x, axis=axis), axis)

    def _backward_along(self, c: jax.Array, axis: int) -> jax.Array:
        """Return the array with these coefficients along one axis."""
        kind, n = self.boundary[axis], self.shape[axis]
        if kind == "periodic":
            is_half = axis == self.half
            return jnp.fft.irfft(c, n, axis) if is_half else jnp.fft.ifft(c, axis=axis)
        if jnp.iscomplexobj(c):
            a = jnp.conj(self._phase_factors(axis, c.dtype))
            x = jnp.fft.ifft(0.5 * a * (c - 1j * _reflect(c, axis, None)), axis=axis)
        else:
            x = jnp.fft.irfft(self._of_cosines(c, axis), n, axis)
        return _unfold(x, axis, kind)

    def _forward(self, x: jax.Array) -> jax.Array:
        if self._uses_matrix():
            return _product(_matrices(self.shape[0], self.boundary[0])[0], x)
        if self._is_line():
            return rfft(x) if not self.real else dct(x, self._sign())
        for axis in self._folded():
            x = _fold(x, axis, self.boundary[axis])
        F = jnp.fft.rfftn(x, axes=self._axes())
        for axis in self._folded():
            if axis != self.half:
                a = self._phase_factors(axis, F.dtype)
                F = a * F + jnp.conj(a) * _reflect(F, axis, F)
        if not self.real:
            return F
        return self._cosines(F, self.half)

    def _cosines(self, F: jax.Array, axis: int) -> jax.Array:
        """Return the real coefficients along an axis from the real Fourier transform of the folded
        array."""
        n = self.shape[axis]
        W = self._phase_factors(axis, F.dtype, n // 2 + 1) * F
        imaginary = jax.lax.slice_in_dim(jnp.imag(W), 1, (n + 1) // 2, axis=axis)
        return 2.0 * jnp.concatenate([jnp.real(W), -jnp.flip(imaginary, axis)], axis)

    def _of_cosines(self, c: jax.Array, axis: int) -> jax.Array:
        """Return F with `_cosines(F, axis)` = c."""
        n = self.shape[axis]
        low = jax.lax.slice_in_dim(c, 0, n // 2 + 1, axis=axis)
        high = jnp.flip(jax.lax.slice_in_dim(c, n - n // 2, n, axis=axis), axis)
        zero = jnp.zeros_like(jax.lax.slice_in_dim(low, 0, 1, axis=axis))
        F = jax.lax.complex(low, -jnp.concatenate([zero, high], axis))
        return 0.5 * jnp.conj(self._phase_factors(axis, F.dtype, n // 2 + 1)) * F

    def _backward(self, c: jax.Array) -> jax.Array:
        if self._uses_matrix():
            return _product(_matrices(self.shape[0], self.boundary[0])[1], c)
        if self._is_line():
            return irfft(c) if not self.real else idct(c, self._sign())
        F = self._of_cosines(c, self.half) if self.real else c
        for axis in self._folded():
            if axis != self.half:
                a = jnp.conj(self._phase_factors(axis, F.dtype))
                F = 0.5 * a * (F - 1j * _reflect(F, axis, None))
        axes = self._axes()
        x = jnp.fft.irfftn(F, s=[self.shape[axis] for axis in axes], axes=axes)
        for axis in self._folded():
            x = _unfold(x, axis, self.boundary[axis])
        return x

    def _uses_matrix(self) -> bool:
        """Return whether a product with a matrix takes less time than a fast transform."""
        return len(self.shape) == 1 and self.real and self.shape[0] <= _MAX_DENSE_POINTS

    def _is_line(self) -> bool:
        """Return whether the transforms of `line` apply."""
        return len(self.shape) == 1 and self.shape[0] % 4 == 0

    def _sign(self) -> float:
        return -1.0 if self.boundary[0] == "dirichlet" else 1.0

    def _axes(self) -> tuple[int, ...]:
        """Return all axes, that of the real transform last."""
        return *(k for k in range(len(self.shape)) if k != self.half), self.half

    def _folded(self) -> list[int]:
        """Return the axes that are not periodic."""
        return [axis for axis, kind in enumerate(self.boundary) if kind != "periodic"]

    def _phase_factors(self, axis: int, dtype: Any, count: int | None = None) -> jax.Array:
        """Return aₖ along an axis."""
        n = self.shape[axis]
        a = np.exp(-0.5j * np.pi * np.arange(n if count is None else count) / n)
        return jnp.asarray(along(a, axis, len(self.shape)), dtype)


@functools.cache
def _matrices(n: int, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrices of the transform of n numbers and of its inverse."""
    k = np.arange(n) if kind == "neumann" else n - np.arange(n)
    # Reduce the angles, as integer multiples of π/2n, modulo 2π, so that they are exact.
    multiples = np.outer(k, 2 * np.arange(n) + 1) % (4 * n)
    modes = (np.cos if kind == "neumann" else np.sin)(multiples * (np.pi / (2 * n)))
    amplitudes = np.where((k == 0) | (k == n), 0.5, 1.0) / n
    return 2.0 * modes, modes.T * amplitudes


def _product(matrix: np.ndarray, v: jax.Array) -> jax.Array:
    """Return the product in the full precision of v, which accelerators reduce by default."""
    return jnp.matmul(jnp.asarray(matrix, v.dtype), v, precision=jax.lax.Precision.HIGHEST)


def times(factor: Any, c: jax.Array) -> jax.Array:
    """Return factor · c without complex arithmetic on a real factor."""
    if jnp.iscomplexobj(c) and not jnp.iscomplexobj(factor):
        return jax.lax.complex(factor * jnp.real(c), factor * jnp.imag(c))
    return factor * c


def along(v: Any, axis: int, count: int) -> Any:
    """Return the vector v as an array of `count` axes that varies along one of them."""
    return v.reshape(*(1,) * axis, -1, *(1,) * (count - 1 - axis))


def _fold(x: jax.Array, axis: int, kind: str) -> jax.Array:
    """Return (x₀, x₂, …, ±x₃, ±x₁) along an axis."""
    n = x.shape[axis]
    even = jax.lax.slice_in_dim(x, 0, n, 2, axis)
    odd = jnp.flip(jax.lax.slice_in_dim(x, 1, n, 2, axis), axis) if n > 1 else x[:0]
    return jnp.concatenate([even, -odd if kind == "dirichlet" else odd], axis) if n > 1 else x


def _unfold(v: jax.Array, axis: int, kind: str) -> jax.Array:
    """Return x with `_fold(x, axis, kind)` = v."""
    n = v.shape[axis]
    if n == 1:
        return v
    even = jax.lax.slice_in_dim(v, 0, (n + 1) // 2, axis=axis)
    odd = jnp.flip(jax.lax.slice_in_dim(v, (n + 1) // 2, n, axis=axis), axis)
    odd = -odd if kind == "dirichlet" else odd
    if n % 2:
        zero = jnp.zeros_like(jax.lax.slice_in_dim(odd, 0, 1, axis=axis))
        odd = jnp.concatenate([odd, zero], axis)
    both = jnp.stack([even, odd], axis + 1)
    shape = (*v.shape[:axis], 2 * even.shape[axis], *v.shape[axis + 1 :])
    return jax.lax.slice_in_dim(both.reshape(shape), 0, n, axis=axis)


def _reflect(F: jax.Array, axis: int, first: jax.Array | None) -> jax.Array:
    """Return Fₙ₋ₖ, with F₀ for k = 0, or 0 if `first` is None."""
    reversed_ = jnp.flip(jax.lax.slice_in_dim(F, 1, F.shape[axis], axis=axis), axis)
    head = jax.lax.slice_in_dim(F, 0, 1, axis=axis)
    return jnp.concatenate([jnp.zeros_like(head) if first is None else head, reversed_], axis)
