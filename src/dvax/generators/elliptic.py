"""Diffusion, advection and reaction with constant coefficients on a box."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding

from .. import _tree
from .._tree import Tree
from ..errors import Problems, input_error
from ..spaces import AbstractSpace
from .abstract import AbstractPropagator, FlowStep, Growth
from .layout import Layout
from .phi import flow_factors, phi_scalar
from .scalar import elementwise_chord_deviation
from .spectral_state import (
    AbstractModal,
    SpectralState,
    coefficients_of,
    in_form_of,
    with_coefficients,
)
from .stencil import Stencil
from .transforms import BOUNDARIES, Transform, along, times


class Elliptic(AbstractModal):
    """A v = Σᵢ dᵢ ∂ᵢ²v − Σᵢ cᵢ ∂ᵢv + r v on a box in one, two or three dimensions.

    This is the Laplacian for d = 1, advection–diffusion with a velocity c, and pure advection (a
    skew-adjoint A) for d = 0. Values are given at the midpoints (j + ½)h of equal cells, h = L/n. A
    is diagonal in the sines, cosines or complex exponentials of its boundary conditions, so e^{tA}
    and the φ-functions are exact for every function that the grid resolves. The eigenvalue of the
    wave number κ is −dκ² − icκ + r. If all points have the same weight the transform is orthogonal,
    so M = 1 and ω is the largest real part.

    **Arguments:**

    - `shape`: cells along each axis, an integer or a tuple;
    - `lengths`: of the box along each axis, one number or one an axis;
    - `boundary`: "periodic", "dirichlet" (v = 0 on the faces) or "neumann" (∂v/∂n = 0), for all axes
      or one an axis;
    - `diffusion` ≥ 0, in length²/time, and `velocity`, in length/time: one number or one an axis; a
      nonzero velocity requires a periodic axis; `reaction`: a number, in 1/time;
    - `scheme`: "spectral", or "differences" for second-order central differences, whose eigenvalues
      are −d (2/h)² sin²(κh/2) and −ic sin(κh)/h.

    **Raises:** `dvax.InputError` if the arguments are invalid or inconsistent.

    Source of the transforms: `dvax.generators.transforms`.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> A = dvax.generators.Elliptic(64, lengths=jnp.pi, boundary="dirichlet")
    >>> s = (jnp.arange(64.0) + 0.5) * jnp.pi / 64
    >>> decayed = A.semigroup(1.0, jnp.sin(3 * s))      # sin 3s has the eigenvalue −9
    >>> bool(jnp.allclose(decayed, jnp.exp(-9.0) * jnp.sin(3 * s), atol=1e-6))
    True

    ```
    """

    symbol: jax.Array
    transform: Transform
    stencil: Stencil | None

    def __init__(
        self,
        shape: SupportsIndex | Sequence[SupportsIndex],
        lengths: Any = 1.0,
        boundary: str | Sequence[str] = "dirichlet",
        diffusion: Any = 1.0,
        velocity: Any = 0.0,
        reaction: Any = 0.0,
        scheme: str = "spectral",
    ):
        shape = _tree.as_shape(
            shape, "dvax.generators.Elliptic(shape)", "Give the number of cells along each axis"
        )
        kinds = _kinds(boundary, len(shape))
        _check(shape, kinds, scheme)
        per_axis = {"lengths": lengths, "diffusion": diffusion, "velocity": velocity}
        L, d, c = (_by_axis(name, value, len(shape)) for name, value in per_axis.items())
        name = "dvax.generators.Elliptic(reaction)"
        r = _tree.as_number(reaction, name, "Add a rate that varies in space to f")
        _check_numbers(L, d, c, kinds)
        self.transform = Transform(shape, kinds)
        real, imaginary = (partial(part, self.transform, scheme) for part in (_real, _imaginary))
        self.symbol = _tree.prepare(real, r, *L, *d)
        if not all(map(_is_zero, c)):
            self.symbol = jax.lax.complex(self.symbol, _tree.prepare(imaginary, *L, *c))
        self.stencil = None
        if scheme == "differences":
            second = tuple(
                _tree.prepare(lambda rate, side, n=n: rate / (side / n) ** 2, *axis)
                for n, *axis in zip(shape, d, L, strict=True)
            )
            first = tuple(
                None
                if _is_zero(rate)
                else _tree.prepare(lambda rate, side, n=n: rate / (2.0 * side / n), rate, side)
                for n, rate, side in zip(shape, c, L, strict=True)
            )
            self.stencil = Stencil(kinds, second, first, r)

    def apply(self, v: Tree) -> Tree:
        if self.stencil is not None:
            return self.stencil.apply(v)
        symbol = self.transform.place(self.symbol)
        return self.transform.backward(times(symbol, self.transform.forward(v)))

    def expand(self, v: Tree, coefficients: Tree = None) -> SpectralState:
        return with_coefficients(v, coefficients, self.transform.forward)

    def propagator(self, h: Any, terms: int) -> "SpectralPropagator":
        h = jnp.asarray(h).astype(self.symbol.dtype)
        symbol = self.transform.place(self.symbol)
        factors = flow_factors(h, phi_scalar(h * symbol, terms))
        return SpectralPropagator(self.transform, factors)

    def sharded(self, sharding: NamedSharding) -> "Elliptic":
        """Return A for states with this sharding: before an axis is transformed, its shards move to
        another axis by an all-to-all. On one axis each device transforms the whole state.

        `dvax.solve` does this by itself, unless A is a function of `args`."""
        layout = Layout.of(sharding, len(self.transform.shape))
        transform = dataclasses.replace(self.transform, layout=layout)
        return eqx.tree_at(
            lambda A: A.transform, self, transform, is_leaf=lambda v: isinstance(v, Transform)
        )

    def check(self, space: AbstractSpace) -> None:
        _tree.fits(
            "dvax.generators.Elliptic(shape)",
            jax.ShapeDtypeStruct(self.transform.shape, jnp.real(self.symbol).dtype),
            space.like(),
            "state space",
        )

    def adjoint(self, space: AbstractSpace) -> "Elliptic":
        weight_ratio = self.growth(space).M
        _tree.require(
            lambda: float(weight_ratio) <= 1.0 + 1e-12,
            "dvax.generators.Elliptic.adjoint(space)", weight_ratio,
            "all points must have the same weight, or A* has no constant coefficients",
            "Use a space with one weight for all points",
        )  # fmt: skip
        stencil = None if self.stencil is None else self.stencil.adjoint()
        adjoint = eqx.tree_at(lambda A: A.symbol, self, jnp.conj(self.symbol))
        return eqx.tree_at(lambda A: A.stencil, adjoint, stencil, is_leaf=lambda leaf: leaf is None)

    def growth(self, space: AbstractSpace) -> Growth:
        # ‖v‖ lies between √(min w) and √(max w) times the Euclidean norm, in which A is normal.
        ratio = _tree.prepare(lambda w: (w.max() / w.min()) ** 0.5, space.weights())
        return Growth(ratio, _tree.prepare(lambda symbol: symbol.real.max(), self.symbol))

    def chord_deviation(self, step: FlowStep, space: AbstractSpace, growth: Growth) -> Tree:
        # Bound each coefficient; eigenfunctions are at most 1 in absolute value.
        h, x0, x1, c = step
        symbol = self.transform.place(self.symbol)
        parts = [coefficients_of(v, self.transform.forward) for v in (x0, x1, *c)]
        if jnp.iscomplexobj(self.symbol):
            start, _, constant, *linear = parts
            slope = times(1.0 / h, linear[0]) if linear else jnp.zeros_like(constant)
            curvature = jnp.abs(symbol * (symbol * start + constant) + slope)
            amplification = jnp.exp(jnp.maximum(jnp.real(symbol), 0.0) * h)
            bounds = h**2 / 8 * amplification * curvature
        else:

            def bound(*parts: jax.Array) -> jax.Array:
                return elementwise_chord_deviation(symbol, h, *parts)

            bounds = _bound_complex(bound, parts)
        amplitudes = self.transform.place(self.transform.amplitudes()).astype(bounds.dtype)
        return jnp.broadcast_to(jnp.sum(amplitudes * bounds), self.transform.shape)


class SpectralPropagator(AbstractPropagator):
    """A propagator that multiplies the coefficients of a transform."""

    transform: Transform
    factors: tuple[jax.Array, ...]

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        parts = [coefficients_of(v, self.transform.forward) for v in (x0, *c)]
        products = [times(f, v) for f, v in zip(self.factors, parts, strict=False)]
        total = sum(products[1:], start=products[0])
        return in_form_of(x0, total, self.transform.backward)


def _bound_complex(bound: Any, parts: list[jax.Array]) -> jax.Array:
    """Return a bound for complex coefficients from the `bound` for real ones."""
    if not jnp.iscomplexobj(parts[0]):
        return bound(*parts)
    real, imaginary = (bound(*map(part, parts)) for part in (jnp.real, jnp.imag))
    return jnp.sqrt(real**2 + imaginary**2)


def _eigenvalues(transform: Transform, axis: int, length: Any, scheme: str) -> tuple[Any, Any]:
    """Return κ² and κ along an axis, or their finite-difference counterparts."""
    n, modes = transform.shape[axis], transform.modes(axis)
    periodic = transform.boundary[axis] == "periodic"
    # The odd derivative of the Nyquist mode is zero on the grid.
    odd = np.where(periodic & (2 * np.abs(modes) == n), 0, modes)
    angle = (2 * np.pi if periodic else np.pi) * np.asarray(modes, float)
    angle_odd = (2 * np.pi if periodic else np.pi) * np.asarray(odd, float)
    if scheme == "differences":
        angle, angle_odd = 2 * n * np.sin(angle / (2 * n)), n * np.sin(angle_odd / n)
    kappa, kappa_odd = (a.astype(length.dtype) / length for a in (angle, angle_odd))
    return kappa**2, kappa_odd


def _real(transform: Transform, scheme: str, reaction: Any, *numbers: Any) -> Any:
    """Return the real parts of the eigenvalues, r − Σ dκ², for `numbers` = lengths and diffusion."""
    count = len(transform.shape)
    for axis, (length, d) in enumerate(zip(numbers[:count], numbers[count:], strict=True)):
        even = _eigenvalues(transform, axis, length, scheme)[0]
        reaction = reaction - along(d * even, axis, count)
    return reaction


def _imaginary(transform: Transform, scheme: str, *numbers: Any) -> Any:
    """Return the imaginary parts of the eigenvalues, −Σ cκ, for `numbers` = lengths and velocity."""
    count, total = len(transform.shape), 0.0
    for axis, (length, c) in enumerate(zip(numbers[:count], numbers[count:], strict=True)):
        odd = _eigenvalues(transform, axis, length, scheme)[1]
        total = total - along(c * odd, axis, count)
    return total


def _by_axis(name: str, value: Any, count: int) -> list[jax.Array]:
    if _tree.is_concrete(value):
        # Keep a concrete number concrete inside the trace of another function.
        with jax.ensure_compile_time_eval():
            return _broadcast_to_axes(name, value, count)
    return _broadcast_to_axes(name, value, count)


def _broadcast_to_axes(name: str, value: Any, count: int) -> list[jax.Array]:
    full = f"dvax.generators.Elliptic({name})"
    array = _tree.as_array([*value] if isinstance(value, tuple) else value, full)
    if array.shape not in ((), (count,)):
        raise input_error(
            full,
            f"shape {array.shape}",
            f"it must be one number, or one for each of the {count} axes",
            f"Give {count} numbers",
        )
    if array.ndim == 0:
        return [array] * count
    return [_tree.prepare(lambda numbers, k=k: numbers[k], array) for k in range(count)]


def _is_zero(v: jax.Array) -> bool:
    return _tree.is_concrete(v) and float(v) == 0.0


def _kinds(boundary: Any, axes: int) -> tuple[Any, ...]:
    """Return the boundary condition of every axis."""
    if isinstance(boundary, str):
        return (boundary,) * axes
    return tuple(boundary) if isinstance(boundary, tuple | list | np.ndarray) else (boundary,)


def _check(shape: tuple[int, ...], kinds: tuple[str, ...], scheme: str) -> None:
    name = "dvax.generators.Elliptic"
    wrong = Problems()
    if not 1 <= len(shape) <= 3:
        wrong.add(f"{name}(shape)", str(shape),
                  "there must be one to three axes of at least one cell",
                  "Give the number of cells along each axis")  # fmt: skip
    if len(kinds) != len(shape) or any(str(kind) not in BOUNDARIES for kind in kinds):
        wrong.add(f"{name}(boundary)", _tree.line(kinds),
                  f"it must be one of {', '.join(BOUNDARIES)}, for all axes or for each",
                  "Choose one of these")  # fmt: skip
    if not isinstance(scheme, str) or scheme not in ("spectral", "differences"):
        wrong.add(f"{name}(scheme)", _tree.line(scheme),
                  "it must be 'spectral' or 'differences'", "Omit it for 'spectral'")  # fmt: skip
    wrong.raise_any()


def _check_numbers(L: list, d: list, c: list, kinds: tuple[str, ...]) -> None:
    name = "dvax.generators.Elliptic"
    _tree.require(
        lambda: all(float(v) > 0 and np.isfinite(float(v)) for v in L), f"{name}(lengths)", L,
        "lengths must be positive and finite", "Give the side lengths of the box",
    )  # fmt: skip
    _tree.require(
        lambda: all(float(v) >= 0 and np.isfinite(float(v)) for v in d), f"{name}(diffusion)", d,
        "the diffusion must be ≥ 0: a negative one generates no semigroup",
        "Change its sign",
    )  # fmt: skip
    for axis, (v, kind) in enumerate(zip(c, kinds, strict=True)):
        if kind != "periodic" and not _is_zero(v):
            raise input_error(
                f"{name}(velocity)",
                f"{_tree.short(v) if _tree.is_concrete(v) else 'a traced number'} along axis "
                f"{axis}, which is {kind}",
                "advection is diagonal only in the Fourier basis, so its axis must be periodic",
                "Add the advection to f, or use dvax.generators.Sparse",
            )
