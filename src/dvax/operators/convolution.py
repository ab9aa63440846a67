"""P as a periodic convolution: translation-invariant, diagonal in Fourier space."""

from collections.abc import Sequence
from typing import Any, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from .abstract import AbstractOperator, Spectrum


class Convolution(AbstractOperator):
    """P v = 𝓕⁻¹(σ · 𝓕v) on a periodic grid of one or two dimensions, with a real symbol σ > 0.

    An elastic half-space, or any other body that looks the same from every point of its surface,
    gives such an operator: traction and displacement of wave number k are in the ratio σ(k). It is
    self-adjoint where all points of the grid weigh the same, and its spectrum is the set of the
    values of σ.

    **Arguments:** `symbol`: σ at the wave numbers of `jnp.fft.rfftn`, an array of the shape
    `(*shape[:-1], shape[-1] // 2 + 1)`; `shape`: that of the grid, an integer or a tuple of one or
    two.

    **Raises:** `dvax.InputError` where a value is not positive and finite, or where σ(k) and σ(−k)
    differ (in the two columns where both are stored): P v would not be real.

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
            raise InputError(
                InputProblem(
                    "dvax.operators.Convolution(symbol, shape)",
                    f"shapes {jnp.shape(self.symbol)} and {self.shape}",
                    f"the grid has one or two dimensions, and the symbol the shape {stored} of "
                    "its rfftn",
                    "Evaluate the symbol at jnp.fft.fftfreq and, along the last axis, rfftfreq",
                )
            )
        _tree.require(
            lambda: jnp.all((self.symbol > 0) & jnp.isfinite(self.symbol)),
            name,
            self.symbol,
            "P must be coercive and bounded, so its symbol is positive and finite",
            "Give the wave number 0 a positive value: that of a rigid motion is often forgotten",
        )
        _tree.require(
            lambda: _even(self.symbol, self.shape),
            name,
            self.symbol,
            "the symbol at k and −k must be the same, or P v is not real",
            "Evaluate it at |k|, or average the two",
        )

    def apply(self, v: Tree) -> Tree:
        return self._filtered(self.symbol, v)

    def inverse(self, v: Tree) -> Tree:
        return self._filtered(1.0 / self.symbol, v)

    def check(self, space: AbstractSpace) -> None:
        name = "dvax.operators.Convolution(symbol)"
        zeros = space.zeros()
        if isinstance(zeros, tuple) or jnp.shape(zeros) != self.shape:
            raise InputError(
                InputProblem(
                    name,
                    f"a grid of shape {self.shape}",
                    f"it acts on the control space, whose elements have shape {_tree.shapes(zeros)}",
                    "Name the space: control_space= of dvax.Problem",
                )
            )
        weights = jnp.asarray(space.weights())
        _tree.require(
            lambda: np.allclose(weights, np.asarray(weights).flat[0], rtol=1e-13, atol=0.0),
            name,
            weights,
            "a convolution is self-adjoint only where all points weigh the same",
            "Use dvax.operators.Dense, or a uniform grid",
        )

    def spectrum(self, space: AbstractSpace) -> Spectrum:
        return Spectrum(jnp.min(self.symbol), jnp.max(self.symbol))

    def _filtered(self, symbol: jax.Array, v: Tree) -> jax.Array:
        waves = jnp.fft.rfftn(v)
        # Part by part: a real symbol is not cast to a complex one, nor to another precision.
        filtered = jax.lax.complex(symbol * waves.real, symbol * waves.imag)
        return jnp.fft.irfftn(filtered, self.shape)


def _even(symbol: jax.Array, shape: tuple[int, ...]) -> bool:
    """Whether σ(k) = σ(−k). Along the last axis −k is not stored, but for 0 and n/2."""
    if len(shape) == 1:
        return True
    kept = np.asarray(symbol)[:, [0] if shape[-1] % 2 else [0, -1]]
    opposite = np.roll(kept[::-1], 1, axis=0)
    return np.allclose(kept, opposite, rtol=1e-6 if kept.dtype == np.float32 else 1e-12, atol=0.0)
