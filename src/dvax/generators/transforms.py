"""The eigenfunctions of constant coefficients on a box: fast transforms by axis.

Along an axis of n cells of width h the points are the midpoints (j + ½)h of the cells, and what is
expanded in is

- "periodic": e^{2πikx/L}, by the complex or the real Fourier transform;
- "neumann" (no flux through the ends): cos(kπx/L), k = 0, …, n − 1;
- "dirichlet" (zero at the ends): sin(kπx/L), k = n, …, 1, in this order.

The cosines are those of J. Makhoul, A fast cosine transform in one and two dimensions, IEEE Trans.
Acoust. Speech Signal Process. 28 (1980): with the even points first and the odd ones backward after
them, v = (x₀, x₂, …, x₃, x₁), and F the Fourier transform of v,

    Σⱼ 2xⱼ cos(kπ(j + ½)/n) = aₖFₖ + āₖF₋ₖ,    aₖ = e^{−iπk/2n},

so one transform of n numbers does, and one pass before and after it. For real x the right side is
2 Re(aₖFₖ), and −2 Im(aₖFₖ) is the value at n − k. With every odd xⱼ negated the same formula yields
the sines of n − k. One short axis by itself is transformed by a product with the matrix of this.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .line import cosines, of_cosines, of_waves, waves

_SHORT = 128
"""Points up to which a transform is a product with a matrix."""

BOUNDARIES = ("periodic", "dirichlet", "neumann")


class Transform(eqx.Module):
    """The transform of real arrays of a shape, axis by axis as `boundary` says, and back.

    Coefficients are real where no axis is periodic; otherwise they are complex, with the last
    periodic axis stored by half, since the other half is conjugate.
    """

    shape: tuple[int, ...] = eqx.field(static=True)
    boundary: tuple[str, ...] = eqx.field(static=True)

    @property
    def half(self) -> int:
        """The axis whose transform is that of real numbers."""
        periodic = [k for k, kind in enumerate(self.boundary) if kind == "periodic"]
        return periodic[-1] if periodic else len(self.shape) - 1

    @property
    def real(self) -> bool:
        """Whether the coefficients are."""
        return "periodic" not in self.boundary

    def modes(self, axis: int) -> np.ndarray:
        """k along an axis, in the order of the coefficients: waves on its whole length where it is
        periodic, half waves otherwise."""
        n = self.shape[axis]
        if self.boundary[axis] == "neumann":
            return np.arange(n)
        if self.boundary[axis] == "dirichlet":
            return n - np.arange(n)
        signed = np.fft.rfftfreq(n) if axis == self.half else np.fft.fftfreq(n)
        return np.round(signed * n).astype(int)

    def shares(self) -> jax.Array:
        """The largest that a coefficient of size 1 can be anywhere."""
        out = np.ones(())
        for axis, (n, kind) in enumerate(zip(self.shape, self.boundary, strict=True)):
            k = self.modes(axis)
            if kind == "periodic":
                share = np.where((axis == self.half) & (k > 0) & (2 * k != n), 2.0, 1.0) / n
            else:
                share = np.where((k == 0) | (k == n), 0.5, 1.0) / n
            out = out * along(share, axis, len(self.shape))
        return jnp.asarray(out)

    def forward(self, x: jax.Array) -> jax.Array:
        """The coefficients."""
        if self._short():
            return _product(_matrices(self.shape[0], self.boundary[0])[0], x)
        if self._by_line():
            return waves(x) if not self.real else cosines(x, self._sign())
        for axis in self._folded():
            x = _fold(x, axis, self.boundary[axis])
        F = jnp.fft.rfftn(x, axes=self._axes())
        for axis in self._folded():
            if axis != self.half:
                a = self._turn(axis, F.dtype)
                F = a * F + jnp.conj(a) * _mirror(F, axis, F)
        if not self.real:
            return F
        n, axis = self.shape[self.half], self.half
        W = self._turn(axis, F.dtype, n // 2 + 1) * F
        rest = jax.lax.slice_in_dim(jnp.imag(W), 1, (n + 1) // 2, axis=axis)
        return 2.0 * jnp.concatenate([jnp.real(W), -jnp.flip(rest, axis)], axis)

    def backward(self, c: jax.Array) -> jax.Array:
        """The array with these coefficients."""
        if self._short():
            return _product(_matrices(self.shape[0], self.boundary[0])[1], c)
        if self._by_line():
            return of_waves(c) if not self.real else of_cosines(c, self._sign())
        if self.real:
            n, axis = self.shape[self.half], self.half
            low = jax.lax.slice_in_dim(c, 0, n // 2 + 1, axis=axis)
            high = jnp.flip(jax.lax.slice_in_dim(c, n - n // 2, n, axis=axis), axis)
            none = jnp.zeros_like(jax.lax.slice_in_dim(low, 0, 1, axis=axis))
            high = jnp.concatenate([none, high], axis)
            F = jax.lax.complex(low, -high)
            F = 0.5 * jnp.conj(self._turn(axis, F.dtype, n // 2 + 1)) * F
        else:
            F = c
        for axis in self._folded():
            if axis != self.half:
                a = jnp.conj(self._turn(axis, F.dtype))
                F = 0.5 * a * (F - 1j * _mirror(F, axis, None))
        axes = self._axes()
        x = jnp.fft.irfftn(F, s=[self.shape[axis] for axis in axes], axes=axes)
        for axis in self._folded():
            x = _unfold(x, axis, self.boundary[axis])
        return x

    def _short(self) -> bool:
        """Whether a product with a matrix takes less time than a fast transform."""
        return len(self.shape) == 1 and self.real and self.shape[0] <= _SHORT

    def _by_line(self) -> bool:
        return len(self.shape) == 1 and self.shape[0] % 4 == 0

    def _sign(self) -> float:
        return -1.0 if self.boundary[0] == "dirichlet" else 1.0

    def _axes(self) -> tuple[int, ...]:
        """All axes, that of the real transform last."""
        return *(k for k in range(len(self.shape)) if k != self.half), self.half

    def _folded(self) -> list[int]:
        return [axis for axis, kind in enumerate(self.boundary) if kind != "periodic"]

    def _turn(self, axis: int, dtype: Any, count: int | None = None) -> jax.Array:
        n = self.shape[axis]
        a = np.exp(-0.5j * np.pi * np.arange(n if count is None else count) / n)
        return jnp.asarray(along(a, axis, len(self.shape)), dtype)


@functools.cache
def _matrices(n: int, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """The transform of n numbers and its inverse, written out."""
    k = np.arange(n) if kind == "neumann" else n - np.arange(n)
    # Angles in whole parts of π/2n, and less than a turn, so that they are exact.
    parts = np.outer(k, 2 * np.arange(n) + 1) % (4 * n)
    waves = (np.cos if kind == "neumann" else np.sin)(parts * (np.pi / (2 * n)))
    shares = np.where((k == 0) | (k == n), 0.5, 1.0) / n
    return 2.0 * waves, waves.T * shares


def _product(matrix: np.ndarray, v: jax.Array) -> jax.Array:
    """To the precision of v, whatever the machine would make of it."""
    return jnp.matmul(jnp.asarray(matrix, v.dtype), v, precision=jax.lax.Precision.HIGHEST)


def times(factor: Any, c: jax.Array) -> jax.Array:
    """The product with coefficients, of which either may be complex."""
    if jnp.iscomplexobj(c) and not jnp.iscomplexobj(factor):
        return jax.lax.complex(factor * jnp.real(c), factor * jnp.imag(c))
    return factor * c


def along(v: Any, axis: int, count: int) -> Any:
    """A vector as an array of `count` axes that varies along one of them."""
    return v.reshape(*(1,) * axis, -1, *(1,) * (count - 1 - axis))


def _fold(x: jax.Array, axis: int, kind: str) -> jax.Array:
    """(x₀, x₂, …, ±x₃, ±x₁)."""
    n = x.shape[axis]
    even = jax.lax.slice_in_dim(x, 0, n, 2, axis)
    odd = jnp.flip(jax.lax.slice_in_dim(x, 1, n, 2, axis), axis) if n > 1 else x[:0]
    return jnp.concatenate([even, -odd if kind == "dirichlet" else odd], axis) if n > 1 else x


def _unfold(v: jax.Array, axis: int, kind: str) -> jax.Array:
    n = v.shape[axis]
    if n == 1:
        return v
    even = jax.lax.slice_in_dim(v, 0, (n + 1) // 2, axis=axis)
    odd = jnp.flip(jax.lax.slice_in_dim(v, (n + 1) // 2, n, axis=axis), axis)
    odd = -odd if kind == "dirichlet" else odd
    if n % 2:
        none = jnp.zeros_like(jax.lax.slice_in_dim(odd, 0, 1, axis=axis))
        odd = jnp.concatenate([odd, none], axis)
    both = jnp.stack([even, odd], axis + 1)
    shape = (*v.shape[:axis], 2 * even.shape[axis], *v.shape[axis + 1 :])
    return jax.lax.slice_in_dim(both.reshape(shape), 0, n, axis=axis)


def _mirror(F: jax.Array, axis: int, first: jax.Array | None) -> jax.Array:
    """Fₙ₋ₖ, with F₀ (or zero) for k = 0."""
    rest = jnp.flip(jax.lax.slice_in_dim(F, 1, F.shape[axis], axis=axis), axis)
    head = jax.lax.slice_in_dim(F, 0, 1, axis=axis)
    return jnp.concatenate([jnp.zeros_like(head) if first is None else head, rest], axis)
