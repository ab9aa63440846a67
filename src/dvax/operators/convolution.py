"""Operators P that are periodic convolutions: translation-invariant, diagonal in Fourier space."""

from collections.abc import Sequence
from typing import Any, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from .abstract import AbstractOperator, Spectrum


class Convolution(AbstractOperator):
    """P v = 𝓕⁻¹(σ · 𝓕v) on a periodic grid of one or two dimensions, with a real symbol σ > 0.

    An elastic half-space, or any other body with a translation-invariant surface, has such an
    operator: σ(k) is the ratio of traction and displacement at the wave number k. P is self-adjoint
    if all points of the grid have the same weight. Its spectrum is the set of the values of σ.

    **Arguments:** `symbol`: σ at the wave numbers of `jnp.fft.rfftn`, an array of the shape
    `(*shape[:-1], shape[-1] // 2 + 1)`; `shape`: of the grid, an integer or a tuple of one or two
    integers.

    **Raises:** `dvax.InputError` if a value is not positive and finite, or if σ(k) and σ(−k) differ
    in the two columns that contain both, since P v would not be real.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> P = dvax.operators.Convolution(jnp.array([4.0, 1.0, 2.0]), shape=4)
    >>> P.apply(jnp.array([1.0, -1.0, 1.0, -1.0])).tolist()
    [2.0, -2.0, 2.0, -2.0]

    ```
    """

    symbol: jax.Array
    shape: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, symbol: Any, shape: SupportsIndex | Sequence[SupportsIndex]):
        name = "dvax.operators.Convolution(symbol)"
        self.symbol = _tree.as_array(symbol, name)
        self.shape = _tree.as_shape(
            shape, "dvax.operators.Convolution(shape)", "Give the shape of v, such as (64, 64)"
        )
        stored = (*self.shape[:-1], self.shape[-1] // 2 + 1) if self.shape else ()
        if len(self.shape) not in (1, 2) or jnp.shape(self.symbol) != stored:
            raise input_error(
                "dvax.operators.Convolution(symbol, shape)",
                f"shapes {jnp.shape(self.symbol)} and {self.shape}",
                f"the grid must have one or two dimensions, and the symbol the shape {stored} "
                "of its rfftn",
                "Evaluate the symbol at jnp.fft.fftfreq and, along the last axis, rfftfreq",
            )
        _tree.require(
            lambda: jnp.all((self.symbol > 0) & jnp.isfinite(self.symbol)),
            name,
            self.symbol,
            "P must be coercive and bounded, so its symbol must be positive and finite",
            "Correct the values that are not; check the wave number 0, a rigid motion",
        )
        _tree.require(
            lambda: _is_even(self.symbol, self.shape),
            name,
            self.symbol,
            "the symbol must be equal at k and −k, or P v is not real",
            "Evaluate it at |k|, or average both values",
        )

    def apply(self, v: Tree) -> Tree:
        return self._filtered(self.symbol, v)

    def inverse(self, v: Tree) -> Tree:
        return self._filtered(1.0 / self.symbol, v)

    def check(self, space: AbstractSpace) -> None:
        name = "dvax.operators.Convolution(symbol)"
        zeros = space.like()
        if isinstance(zeros, tuple) or jnp.shape(zeros) != self.shape:
            raise input_error(
                name,
                f"a grid of shape {self.shape}",
                f"it acts on the control space, whose elements have shape {_tree.shapes(zeros)}",
                "Pass control_space= to dvax.Problem",
            )
        weights = jnp.asarray(space.weights())
        _tree.require(
            lambda: np.allclose(weights, np.asarray(weights).flat[0], rtol=1e-13, atol=0.0),
            name,
            weights,
            "all points must have the same weight, or a convolution is not self-adjoint",
            "Use dvax.operators.Dense, or a uniform grid",
        )

    def spectrum(self, space: AbstractSpace) -> Spectrum:
        return Spectrum(jnp.min(self.symbol), jnp.max(self.symbol))

    def _filtered(self, symbol: jax.Array, v: Tree) -> jax.Array:
        spectrum = jnp.fft.rfftn(v)
        # Multiply real and imaginary parts separately, to avoid a cast of the symbol.
        filtered = jax.lax.complex(symbol * spectrum.real, symbol * spectrum.imag)
        return jnp.fft.irfftn(filtered, self.shape)


def _is_even(symbol: jax.Array, shape: tuple[int, ...]) -> bool:
    """Return whether σ(k) = σ(−k) in the columns 0 and n/2, the only ones that contain both."""
    if len(shape) == 1:
        return True
    columns = np.asarray(symbol)[:, [0] if shape[-1] % 2 else [0, -1]]
    opposite = np.roll(columns[::-1], 1, axis=0)
    rtol = 1e-6 if columns.dtype == np.float32 else 1e-12
    return np.allclose(columns, opposite, rtol=rtol, atol=0.0)
