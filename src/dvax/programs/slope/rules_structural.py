"""The rules of slope arithmetic for operations that rearrange or add entries, and for products."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..._jax.jaxprs import bind
from ..interpreter import Rule, same_for
from .values import (
    Part,
    Slope,
    Values,
    added,
    between,
    columns,
    is_slope,
    lift,
    mapped,
    negative,
    together,
)

Move = Callable[[Any, int, list[Values]], Values]
"""A function of an equation, a number of extra axes in front, and the arguments with these axes, which
returns the result of the operation."""


def _linear(move: Move) -> Rule:
    """Return the rule of a linear operation: it acts on the columns of derivatives as on values."""

    def rule(eqn: Any, operands: list[Any]) -> Slope:
        x = [lift(v, tuple(atom.aval.shape)) for v, atom in zip(operands, eqn.invars, strict=True)]
        out = eqn.outvars[0].aval
        # A reshape may permute the axes first.
        permutes = eqn.primitive.name == "reshape" and eqn.params["dimensions"] is not None
        in_order = eqn.primitive.name in _IN_ORDER and out.size == x[0].low.size and not permutes
        size = max([out.size, *(v.low.size for v in x)])
        parts = {}
        for k, own in together(x, full=len(x) > 1, size=size).items():
            is_diagonal = in_order and not own[0].full
            if is_diagonal:
                center, radius = (v.reshape(out.shape) for v in own[0][:2])
            else:
                full = [columns(part, size) for part in own]
                center, radius = (move(eqn, 1, [part[i] for part in full]) for i in (0, 1))
            parts[k] = Part(center, radius, not is_diagonal)
        low, high = move(eqn, 0, [v.low for v in x]), move(eqn, 0, [v.high for v in x])
        return Slope(low, high, parts)

    return rule


_IN_ORDER = {"reshape", "squeeze", "expand_dims", "broadcast_in_dim", "copy", "copy_p"}


def _identity(eqn: Any, extra: int, operands: list[Values]) -> Values:
    return operands[0]


def _reshape(eqn: Any, extra: int, operands: list[Values]) -> Values:
    (v,) = operands
    order = eqn.params.get("dimensions") if eqn.primitive.name == "reshape" else None
    if order is not None:
        v = v.transpose(*range(extra), *(extra + axis for axis in order))
    return v.reshape((*v.shape[:extra], *eqn.outvars[0].aval.shape))


def _broadcast_in_dim(eqn: Any, extra: int, operands: list[Values]) -> Values:
    (v,) = operands
    shape = eqn.outvars[0].aval.shape
    wide = [1] * len(shape)
    for axis, place in enumerate(eqn.params["broadcast_dimensions"]):
        wide[place] = v.shape[extra + axis]
    return np.broadcast_to(v.reshape((*v.shape[:extra], *wide)), (*v.shape[:extra], *shape))


def _transpose(eqn: Any, extra: int, operands: list[Values]) -> Values:
    order = [extra + axis for axis in eqn.params["permutation"]]
    return operands[0].transpose(*range(extra), *order)


def _slice(eqn: Any, extra: int, operands: list[Values]) -> Values:
    p = eqn.params
    strides = p["strides"] or (1,) * len(p["start_indices"])
    cuts = [slice(*cut) for cut in zip(p["start_indices"], p["limit_indices"], strides)]
    return operands[0][(*(slice(None),) * extra, *cuts)]


def _rev(eqn: Any, extra: int, operands: list[Values]) -> Values:
    return np.flip(operands[0], tuple(extra + axis for axis in eqn.params["dimensions"]))


def _reduce_sum(eqn: Any, extra: int, operands: list[Values]) -> Values:
    return operands[0].sum(axis=tuple(extra + axis for axis in eqn.params["axes"]))


def _concatenate(eqn: Any, extra: int, operands: list[Values]) -> Values:
    return np.concatenate(operands, eqn.params["dimension"] + extra)


def _stack(eqn: Any, extra: int, operands: list[Values]) -> Values:
    return np.stack(operands, eqn.params["axis"] + extra)


def _split(eqn: Any, operands: list[Any]) -> list[Slope]:
    """Return the pieces along an axis, for example those of `ravel_pytree`."""
    axis, sizes = eqn.params["axis"], list(map(int, eqn.params["sizes"]))
    if len(sizes) == 1:
        return operands
    pieces = []
    for end, size in zip(np.cumsum(sizes), sizes, strict=True):
        cut = slice(end - size, end)
        take = lambda eqn, extra, v, cut=cut: v[0][(*(slice(None),) * (extra + axis), cut)]  # noqa: E731
        pieces.append(_linear(take)(eqn, operands))
    return pieces


def _unstack(eqn: Any, operands: list[Any]) -> list[Slope]:
    """Return the rows along an axis. From JAX 0.12 on, `x, v = state` is this operation."""
    axis, rows = eqn.params["axis"], []
    for k in range(len(eqn.outvars)):
        take = lambda eqn, extra, v, k=k: np.take(v[0], k, axis=extra + axis)  # noqa: E731
        rows.append(_linear(take)(eqn, operands))
    return rows


def _indexed(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of an operation that is linear in its first argument, with constant indices in
    the others: apply it to each column of the derivatives."""
    x, *indices = operands
    if any(map(is_slope, indices)):
        return None

    def derivative(stack: Values) -> Values:
        # Fill values are constants, with derivative 0.
        params = dict(eqn.primitive.get_bind_params(eqn.params))
        if "fill_value" in params:
            params["fill_value"] = 0.0
        each = [eqn.primitive.bind(jnp.asarray(v), *indices, **params) for v in stack]
        return np.stack([np.asarray(v) for v in each])

    def derivative_part(part: Part) -> Part:
        full = columns(part, max(x.low.size, eqn.outvars[0].aval.size))
        return Part(derivative(full.center), derivative(full.radius), True)

    low, high = (np.asarray(bind(eqn, [jnp.asarray(v), *indices])[0]) for v in (x.low, x.high))
    return Slope(low, high, mapped(x.parts, derivative_part))


def _reduce_max(eqn: Any, operands: list[Any]) -> Slope:
    """Return the largest entry, whose derivative lies in the hull of those of all entries."""
    (x,) = operands
    axes = tuple(eqn.params["axes"])

    def largest(part: Part) -> Part:
        full = columns(part, x.low.size)
        behind = tuple(axis + 1 for axis in axes)
        low = (full.center - full.radius).min(axis=behind)
        return between(low, (full.center + full.radius).max(axis=behind), True)

    return Slope(x.low.max(axis=axes), x.high.max(axis=axes), mapped(x.parts, largest))


def _reduce_min(eqn: Any, operands: list[Any]) -> Slope:
    return negative(_reduce_max(eqn, [negative(operands[0])]))


def _einsum(eqn: Any, extra: tuple[int, int]) -> str:
    """Return the einsum formula of a dot_general with `extra` axes in front of each side."""
    (of_left, of_right), (batch_left, batch_right) = eqn.params["dimension_numbers"]
    names = iter("abcdefghijklmnopqrstuvw")
    left = [next(names) for _ in eqn.invars[0].aval.shape]
    right = [next(names) for _ in eqn.invars[1].aval.shape]
    for i, j in [*zip(of_left, of_right), *zip(batch_left, batch_right)]:
        right[j] = left[i]
    batch = [left[i] for i in batch_left]
    free_left = [c for i, c in enumerate(left) if i not in (*of_left, *batch_left)]
    free_right = [c for j, c in enumerate(right) if j not in (*of_right, *batch_right)]
    out = [*batch, *free_left, *free_right]
    front = "z" * (extra[0] + extra[1])
    sides = "z" * extra[0] + "".join(left), "z" * extra[1] + "".join(right)
    return f"{sides[0]},{sides[1]}->{front}{''.join(out)}"


class _Ball(NamedTuple):
    """An interval array as center and radius."""

    center: Values
    radius: Values


def _ball(x: Slope) -> _Ball:
    return _Ball(*between(np.asarray(x.low, float), np.asarray(x.high, float), True)[:2])


def _times(spec: str, x: Any, y: Any) -> _Ball:
    """Return the product of two interval arrays."""

    def dot(a: Values, b: Values) -> Values:
        return np.einsum(spec, a, b, optimize=True)

    def bound(a: Values, b: Values) -> Values:
        infinite = dot(np.isinf(a) * 1.0, (b > 0) * 1.0) + dot((a > 0) * 1.0, np.isinf(b) * 1.0)
        finite = dot(np.where(np.isinf(a), 0.0, a), np.where(np.isinf(b), 0.0, b))
        return np.where(infinite > 0, np.inf, finite)

    radius = bound(np.abs(x.center), y.radius) + bound(x.radius, np.abs(y.center) + y.radius)
    return _Ball(dot(x.center, y.center), radius)


def _dot_general(eqn: Any, operands: list[Any]) -> Slope:
    left, right = (lift(v, tuple(atom.aval.shape)) for v, atom in zip(operands, eqn.invars))
    x, y = _ball(left), _ball(right)
    value = _times(_einsum(eqn, (0, 0)), x, y)
    out = eqn.outvars[0].aval.size

    def by(side: Slope, spec: str, times: Callable[[str, Part], _Ball]) -> Slope:
        """Return the derivatives of the product through one side."""
        full = lambda part: columns(part, max(side.low.size, out))  # noqa: E731
        parts = mapped(side.parts, lambda part: Part(*times(spec, full(part)), True))
        return Slope(value.center, value.center, parts)

    by_left = by(left, _einsum(eqn, (1, 0)), lambda spec, part: _times(spec, part, y))
    by_right = by(right, _einsum(eqn, (0, 1)), lambda spec, part: _times(spec, x, part))
    parts = added(by_left, by_right)
    return Slope(value.center - value.radius, value.center + value.radius, parts)


STRUCTURAL: dict[str, Rule] = {
    **same_for({"stop_gradient", "copy", "copy_p"}, _linear(_identity)),
    **same_for({"reshape", "squeeze", "expand_dims"}, _linear(_reshape)),
    "broadcast_in_dim": _linear(_broadcast_in_dim),
    "transpose": _linear(_transpose),
    "slice": _linear(_slice),
    "rev": _linear(_rev),
    "reduce_sum": _linear(_reduce_sum),
    "concatenate": _linear(_concatenate),
    "stack": _linear(_stack),
    "split": _split,
    "unstack": _unstack,
    **same_for({"gather", "dynamic_slice", "cumsum"}, _indexed),
    "reduce_max": _reduce_max,
    "reduce_min": _reduce_min,
    "dot_general": _dot_general,
}
