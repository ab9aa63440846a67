"""Measured data: piecewise constant, piecewise linear or cubic interpolation of samples."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .. import _tree
from .._lookup import count_up_to
from ..errors import input_error
from .abstract import AbstractSignal

Kind = Literal["constant", "linear", "cubic"]


class Table(AbstractSignal):
    """The interpolant of data (tᵢ, vᵢ), defined on [t₀, t_last] and NaN outside.

    - `kind="constant"`: vᵢ on [tᵢ, tᵢ₊₁), with a jump at every time;
    - `kind="linear"`: piecewise linear, with kinks at the times;
    - `kind="cubic"`: the C² spline with not-a-knot ends, whose third derivative jumps at the times.

    **Arguments:** `times`: increasing, at least two (four for cubic); `values`: one a time along
    the first axis, of any trailing shape.

    **Raises:** `dvax.InputError` if times do not increase, lengths differ, or data are not finite.

    ```python
    >>> import dvax
    >>> load = dvax.signals.Table([0.0, 1.0, 2.0], [0.0, 4.0, 2.0])
    >>> float(load(1.5))
    3.0
    >>> float(dvax.signals.Table([0.0, 1.0, 2.0], [0.0, 4.0, 2.0], kind="constant")(1.0))
    4.0

    ```
    """

    times: jax.Array | np.ndarray
    values: jax.Array
    slopes: jax.Array | None
    kind: Kind = eqx.field(static=True)

    def __init__(self, times: Any, values: Any, kind: Kind = "linear"):
        name = "dvax.signals.Table"
        if kind not in ("constant", "linear", "cubic"):
            raise input_error(
                f"{name}(kind)",
                repr(kind),
                "it must be 'constant', 'linear' or 'cubic'",
                "Choose one of them",
            )
        # Concrete times are NumPy arrays, so that knots are known without running a program.
        self.times = _numbers(times, f"{name}(times)")
        self.values = _tree.as_float(
            values if hasattr(values, "dtype") else _numbers(values, f"{name}(values)"),
            f"{name}(values)",
        )
        self.kind = kind
        _check(name, self.times, self.values, min_count=4 if kind == "cubic" else 2)
        self.slopes = _spline_slopes(self.times, self.values) if kind == "cubic" else None

    def value(self, t: Any) -> jax.Array:
        if jnp.ndim(t):
            return jax.vmap(self.value)(t)
        times = jnp.asarray(self.times)
        if self.kind == "constant":
            return dvax_constant_table(times, self.values, t)
        if self.slopes is None:
            return dvax_linear_table(times, self.values, t)
        return dvax_cubic_table(times, self.values, self.slopes, t)

    def knots(self) -> Any:
        return self.times

    def span(self) -> tuple[Any, Any]:
        return self.times[0], self.times[-1]


def _numbers(values: Any, name: str) -> Any:
    try:
        if _tree.is_concrete(values):
            if np.asarray(values).dtype.kind in "mMUS":
                raise TypeError("dates have no unit that t would have, and texts are no numbers")
            return np.asarray(values, dtype=float)
        return values if hasattr(values, "dtype") else jnp.asarray(values, float)
    except (TypeError, ValueError):
        dates = "datetime" in repr(values)
        raise input_error(
            name, " ".join(repr(values).split())[:120], "it must be a list or array of numbers",
            "Give the numbers since a date: (times - times[0]) / np.timedelta64(1, 'h')" if dates
            else "Give numbers, in rows of one length",
        ) from None  # fmt: skip


# Jitted separately: `dvax.programs` has rules for functions of these names.


@jax.jit
def dvax_constant_table(times: jax.Array, values: jax.Array, t: Any) -> jax.Array:
    """Return vᵢ for t in [tᵢ, tᵢ₊₁)."""
    i, (_, right) = _locate(times, t)
    v0, v1 = _pair(values, i)
    return _nan_outside(times, t, jnp.where(t >= right, v1, v0))


@jax.jit
def dvax_linear_table(times: jax.Array, values: jax.Array, t: Any) -> jax.Array:
    """Return the piecewise linear interpolant at t."""
    i, (left, right) = _locate(times, t)
    v0, v1 = _pair(values, i)
    return _nan_outside(times, t, v0 + (t - left) / (right - left) * (v1 - v0))


@jax.jit
def dvax_cubic_table(times: jax.Array, values: jax.Array, slopes: jax.Array, t: Any) -> jax.Array:
    """Return the cubic Hermite interpolant with these slopes at t."""
    i, (left, right) = _locate(times, t)
    width = right - left
    s = (t - left) / width
    v0, v1 = _pair(values, i)
    d0, d1 = (slope * width for slope in _pair(slopes, i))
    jump = v1 - v0
    out = v0 + s * (d0 + s * ((3 * jump - 2 * d0 - d1) + s * (d0 + d1 - 2 * jump)))
    return _nan_outside(times, t, out)


def _locate(times: jax.Array, t: Any) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    """Return i and (tᵢ, tᵢ₊₁) with tᵢ ≤ t ≤ tᵢ₊₁."""
    last = times.shape[0] - 2
    i = lax.clamp(np.int32(0), count_up_to(times, t) - 1, np.int32(last))
    return i, _pair(times, i)


def _pair(rows: jax.Array, i: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the rows i and i + 1, which exist."""
    pair = lax.dynamic_slice_in_dim(rows, i, 2, allow_negative_indices=False)
    return pair[0], pair[1]


def _nan_outside(times: jax.Array, t: Any, out: jax.Array) -> jax.Array:
    return jnp.where((t >= times[0]) & (t <= times[-1]), out, jnp.nan)


def _check(name: str, times: Any, values: jax.Array, min_count: int) -> None:
    if np.ndim(times) != 1 or times.shape[0] < min_count or values.shape[:1] != times.shape:
        raise input_error(
            f"{name}(times, values)",
            f"shapes {np.shape(times)} and {values.shape}",
            f"times must be a vector of at least {min_count} entries, with one value for each",
            "Give one value (or row of values) for each time",
        )
    if isinstance(times, np.ndarray):
        gaps = np.flatnonzero(~np.isfinite(times))
        if gaps.size:
            raise input_error(
                f"{name}(times)",
                f"times[{gaps[0]}] = {times[gaps[0]]}",
                "times must be finite",
                "Remove the rows without a time",
            )
        wrong = np.flatnonzero(~(np.diff(times) > 0))
        if wrong.size:
            i = int(wrong[0])
            raise input_error(
                f"{name}(times)",
                f"times[{i}] = {times[i]:.17g}, times[{i + 1}] = {times[i + 1]:.17g}",
                "times must increase strictly, or the signal has two values at one time",
                "Sort the data and remove repeated times",
            )
    if _tree.is_concrete(values):
        gaps = np.argwhere(~np.isfinite(values))
        if len(gaps):
            index = ", ".join(map(str, gaps[0]))
            raise input_error(
                f"{name}(values)",
                f"values[{index}] = {values[tuple(gaps[0])]}, the first of {len(gaps)}",
                "measured values must be finite",
                "Remove the times of missing values, or fill them explicitly",
            )


def _spline_slopes(times: Any, values: jax.Array) -> jax.Array:
    """Return the derivatives at the knots of the not-a-knot C² spline (de Boor 1978, chapter IV).

    Continuity of the second derivative at inner knots is a tridiagonal system for the slopes. The first
    and the last row state that one cubic covers the first two and the last two intervals.
    """
    t = jnp.asarray(times)
    n = t.shape[0]
    flat = values.reshape(n, -1)
    h = jnp.diff(t)
    d = jnp.diff(flat, axis=0) / h[:, None]
    inner = 3 * (h[1:, None] * d[:-1] + h[:-1, None] * d[1:])
    a, b = h[0], h[1]
    first = ((a + 2 * (a + b)) * b * d[0] + a * a * d[1]) / (a + b)
    p, q = h[-1], h[-2]
    last = ((p + 2 * (p + q)) * q * d[-1] + p * p * d[-2]) / (p + q)
    lower = jnp.concatenate([jnp.zeros(1), h[1:], (p + q)[None]])
    main = jnp.concatenate([b[None], 2 * (h[:-1] + h[1:]), q[None]])
    upper = jnp.concatenate([(a + b)[None], h[:-1], jnp.zeros(1)])
    rhs = jnp.concatenate([first[None], inner, last[None]])
    return jax.lax.linalg.tridiagonal_solve(lower, main, upper, rhs).reshape(values.shape)
