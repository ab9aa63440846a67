"""Constant coefficients on a box: diffusion, advection, reaction."""

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
from .abstract import AbstractPropagator, Arc, Growth
from .expanded import AbstractModal, Expanded, as_given, coefficients_of, with_coefficients
from .phi import flow_factors, phi_scalar
from .scalar import elementwise_bend
from .stencil import Stencil
from .transforms import BOUNDARIES, Transform, along, times


class Elliptic(AbstractModal):
    """A v = Σᵢ dᵢ ∂ᵢ²v − Σᵢ cᵢ ∂ᵢv + r v on a box of one, two or three dimensions: the Laplacian for
    d = 1, advection–diffusion with a velocity c, pure advection (skew) for d = 0.

    Values sit at the midpoints (j + ½)h of equal cells, h = L/n. A is diagonal in the sines, cosines
    and waves that its boundary conditions allow, so e^{tA} and the φ-functions are exact for what
    the grid can show: wave number κ belongs to the eigenvalue −dκ² − icκ + r. In the norm of any
    space that weighs all points alike the transform is orthogonal, so M = 1 and ω is the largest
    real part.

    **Arguments:**

    - `shape`: cells along each axis, an integer or a tuple;
    - `lengths`: of the box along each axis, one number or one an axis;
    - `boundary`: "periodic", "dirichlet" (v = 0 on the faces) or "neumann" (∂v/∂n = 0), for all axes
      or one an axis;
    - `diffusion` ≥ 0, in length²/time, and `velocity`, in length/time: one number or one an axis; a
      velocity other than 0 needs a periodic axis; `reaction`: a number, in 1/time;
    - `scheme`: "spectral", or "differences" for the three-point formula of order two, whose
      eigenvalues are −d (2/h)² sin²(κh/2) and −ic sin(κh)/h.

    **Raises:** `dvax.InputError` where these do not fit together.

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
        r = _tree.as_number(reaction, name, "Put a rate that varies in space into f")
        _check_numbers(L, d, c, kinds)
        self.transform = Transform(shape, kinds)
        growing, turning = r, jnp.zeros_like(r)
        for axis in range(len(shape)):
            even, odd = _eigenvalues(self.transform, axis, L[axis], scheme)
            growing = growing - along(d[axis] * even, axis, len(shape))
            turning = turning - along(c[axis] * odd, axis, len(shape))
        still = all(map(_is_zero, c))
        self.symbol = growing if still else jax.lax.complex(growing, turning)
        self.stencil = None
        if scheme == "differences":
            cells = [side / n for side, n in zip(L, shape, strict=True)]
            second = tuple(rate / cell**2 for rate, cell in zip(d, cells, strict=True))
            first = tuple(
                None if _is_zero(rate) else rate / (2.0 * cell)
                for rate, cell in zip(c, cells, strict=True)
            )
            self.stencil = Stencil(kinds, second, first, r)

    def apply(self, v: Tree) -> Tree:
        if self.stencil is not None:
            return self.stencil.apply(v)
        return self.transform.backward(times(self.symbol, self.transform.forward(v)))

    def expand(self, v: Tree, known: Tree = None) -> Expanded:
        return with_coefficients(v, known, self.transform.forward)

    def propagator(self, h: Any, terms: int) -> "SpectralPropagator":
        h = jnp.asarray(h).astype(self.symbol.dtype)
        factors = flow_factors(h, phi_scalar(h * self.symbol, terms))
        return SpectralPropagator(self.transform, factors)

    def check(self, space: AbstractSpace) -> None:
        _tree.fits(
            "dvax.generators.Elliptic(shape)",
            jax.ShapeDtypeStruct(self.transform.shape, jnp.real(self.symbol).dtype),
            space.zeros(),
            "state space",
        )

    def adjoint(self, space: AbstractSpace) -> "Elliptic":
        alike = self.growth(space).M
        _tree.require(
            lambda: float(alike) <= 1.0 + 1e-12, "dvax.generators.Elliptic.adjoint(space)", alike,
            "where points weigh differently A* has no constant coefficients",
            "Use a space that weighs them alike",
        )  # fmt: skip
        stencil = None if self.stencil is None else self.stencil.adjoint()
        turned = eqx.tree_at(lambda A: A.symbol, self, jnp.conj(self.symbol))
        return eqx.tree_at(lambda A: A.stencil, turned, stencil, is_leaf=lambda leaf: leaf is None)

    def growth(self, space: AbstractSpace) -> Growth:
        # ‖v‖ lies between the roots of the least and the largest weight times the plain norm, in which
        # the semigroup is that of a normal operator.
        w = space.weights()
        return Growth(jnp.sqrt(jnp.max(w) / jnp.min(w)), jnp.max(jnp.real(self.symbol)))

    def bend(self, arc: Arc, space: AbstractSpace, growth: Growth) -> Tree:
        # Coefficient by coefficient; an eigenfunction is at most 1 anywhere.
        h, x0, x1, c = arc
        parts = [coefficients_of(v, self.transform.forward) for v in (x0, x1, *c)]
        if jnp.iscomplexobj(self.symbol):
            start, _, first, *rest = parts
            slope = times(1.0 / h, rest[0]) if rest else jnp.zeros_like(first)
            curvature = jnp.abs(self.symbol * (self.symbol * start + first) + slope)
            rise = jnp.exp(jnp.maximum(jnp.real(self.symbol), 0.0) * h)
            leaves = h**2 / 8 * rise * curvature
        else:
            leaves = _both(lambda *p: elementwise_bend(self.symbol, h, *p), parts)
        return jnp.broadcast_to(
            jnp.sum(self.transform.shares().astype(leaves.dtype) * leaves), self.transform.shape
        )


class SpectralPropagator(AbstractPropagator):
    """Factors that multiply the coefficients of a transform."""

    transform: Transform
    factors: tuple[jax.Array, ...]

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        parts = [coefficients_of(v, self.transform.forward) for v in (x0, *c)]
        products = [times(f, v) for f, v in zip(self.factors, parts, strict=False)]
        total = sum(products[1:], start=products[0])
        return as_given(x0, total, self.transform.backward)


def _both(bend: Any, parts: list[jax.Array]) -> jax.Array:
    """A bound for complex coefficients from one for real ones."""
    if not jnp.iscomplexobj(parts[0]):
        return bend(*parts)
    real, imaginary = (bend(*map(part, parts)) for part in (jnp.real, jnp.imag))
    return jnp.sqrt(real**2 + imaginary**2)


def _eigenvalues(
    transform: Transform, axis: int, length: jax.Array, scheme: str
) -> tuple[jax.Array, jax.Array]:
    """κ² and κ, or what differences make of them."""
    n, modes = transform.shape[axis], transform.modes(axis)
    periodic = transform.boundary[axis] == "periodic"
    # The wave of two cells is its own mirror image: an odd derivative of it is nowhere on the grid.
    odd = np.where(periodic & (2 * np.abs(modes) == n), 0, modes)
    angle = (2 * np.pi if periodic else np.pi) * np.asarray(modes, float)
    angle_odd = (2 * np.pi if periodic else np.pi) * np.asarray(odd, float)
    if scheme == "differences":
        angle, angle_odd = 2 * n * np.sin(angle / (2 * n)), n * np.sin(angle_odd / n)
    kappa, kappa_odd = (jnp.asarray(a, length.dtype) / length for a in (angle, angle_odd))
    return kappa**2, kappa_odd


def _by_axis(name: str, value: Any, count: int) -> list[jax.Array]:
    if _tree.is_concrete(value):
        # A number that is known stays known while something else is traced.
        with jax.ensure_compile_time_eval():
            return _one_each(name, value, count)
    return _one_each(name, value, count)


def _one_each(name: str, value: Any, count: int) -> list[jax.Array]:
    full = f"dvax.generators.Elliptic({name})"
    array = _tree.as_array([*value] if isinstance(value, tuple) else value, full)
    if array.shape not in ((), (count,)):
        raise InputError(
            InputProblem(
                full,
                f"shape {array.shape}",
                f"one number, or one for each of the {count} axes",
                f"Give {count} numbers",
            )
        )
    return list(jnp.broadcast_to(array, (count,)))


def _is_zero(v: jax.Array) -> bool:
    return _tree.is_concrete(v) and float(v) == 0.0


def _kinds(boundary: Any, axes: int) -> tuple[Any, ...]:
    """The boundary condition of every axis."""
    if isinstance(boundary, str):
        return (boundary,) * axes
    return tuple(boundary) if isinstance(boundary, tuple | list | np.ndarray) else (boundary,)


def _check(shape: tuple[int, ...], kinds: tuple[str, ...], scheme: str) -> None:
    name = "dvax.generators.Elliptic"
    wrong: list[InputProblem] = []
    if not 1 <= len(shape) <= 3:
        wrong.append(
            InputProblem(f"{name}(shape)", str(shape), "one to three axes of at least one cell",
                         "Give the number of cells along each axis")
        )  # fmt: skip
    if len(kinds) != len(shape) or any(str(kind) not in BOUNDARIES for kind in kinds):
        wrong.append(
            InputProblem(f"{name}(boundary)", _tree.line(kinds),
                         f"one of {', '.join(BOUNDARIES)}, for all axes or one for each",
                         "Choose from these")
        )  # fmt: skip
    if not isinstance(scheme, str) or scheme not in ("spectral", "differences"):
        wrong.append(
            InputProblem(f"{name}(scheme)", _tree.line(scheme), "'spectral' or 'differences'",
                         "Leave it out for the spectral one")
        )  # fmt: skip
    if wrong:
        raise InputError(*wrong)


def _check_numbers(L: list, d: list, c: list, kinds: tuple[str, ...]) -> None:
    name = "dvax.generators.Elliptic"
    _tree.require(
        lambda: all(float(v) > 0 and np.isfinite(float(v)) for v in L), f"{name}(lengths)", L,
        "lengths must be positive and finite", "Give the sides of the box",
    )  # fmt: skip
    _tree.require(
        lambda: all(float(v) >= 0 and np.isfinite(float(v)) for v in d), f"{name}(diffusion)", d,
        "a diffusion must be ≥ 0: backward in time nothing generates a semigroup",
        "Mend its sign",
    )  # fmt: skip
    for axis, (v, kind) in enumerate(zip(c, kinds, strict=True)):
        if kind != "periodic" and not _is_zero(v):
            raise InputError(
                InputProblem(
                    f"{name}(velocity)",
                    f"{_tree.short(v) if _tree.is_concrete(v) else 'a traced number'} along axis "
                    f"{axis}, which is {kind}",
                    "advection is diagonal in waves alone, so its axis must be periodic",
                    "Put the advection into f, or give the operator as a sparse matrix",
                )
            )
