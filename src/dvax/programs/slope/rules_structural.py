"""The rules of slope arithmetic for operations that move entries about or add them up."""

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
"""From an equation, a number of extra axes in front and its arguments with those axes to its result."""


def _linear(move: Move) -> Rule:
    """What moves entries about or adds them up, as it does with those of every derivative."""

    def rule(eqn: Any, given: list[Any]) -> Slope:
        x = [lift(v, tuple(atom.aval.shape)) for v, atom in zip(given, eqn.invars, strict=True)]
        out = eqn.outvars[0].aval
        # A reshape may permute the axes first.
        permutes = eqn.primitive.name == "reshape" and eqn.params["dimensions"] is not None
        in_order = eqn.primitive.name in _IN_ORDER and out.size == x[0].low.size and not permutes
        most = max([out.size, *(v.low.size for v in x)])
        parts = {}
        for k, moved in together(x, full=len(x) > 1, size=most).items():
            diagonal = in_order and not moved[0].full
            if diagonal:
                center, radius = (v.reshape(out.shape) for v in moved[0][:2])
            else:
                full = [columns(part, most) for part in moved]
                center, radius = (move(eqn, 1, [part[i] for part in full]) for i in (0, 1))
            parts[k] = Part(center, radius, not diagonal)
        low, high = move(eqn, 0, [v.low for v in x]), move(eqn, 0, [v.high for v in x])
        return Slope(low, high, parts)

    return rule


_IN_ORDER = {"reshape", "squeeze", "expand_dims", "broadcast_in_dim", "copy", "copy_p"}


def _as_it_is(eqn: Any, extra: int, given: list[Values]) -> Values:
    return given[0]


def _reshape(eqn: Any, extra: int, given: list[Values]) -> Values:
    (v,) = given
    order = eqn.params.get("dimensions") if eqn.primitive.name == "reshape" else None
    if order is not None:
        v = v.transpose(*range(extra), *(extra + axis for axis in order))
    return v.reshape((*v.shape[:extra], *eqn.outvars[0].aval.shape))


def _broadcast_in_dim(eqn: Any, extra: int, given: list[Values]) -> Values:
    (v,) = given
    shape = eqn.outvars[0].aval.shape
    wide = [1] * len(shape)
    for axis, place in enumerate(eqn.params["broadcast_dimensions"]):
        wide[place] = v.shape[extra + axis]
    return np.broadcast_to(v.reshape((*v.shape[:extra], *wide)), (*v.shape[:extra], *shape))


def _transpose(eqn: Any, extra: int, given: list[Values]) -> Values:
    order = [extra + axis for axis in eqn.params["permutation"]]
    return given[0].transpose(*range(extra), *order)


def _slice(eqn: Any, extra: int, given: list[Values]) -> Values:
    p = eqn.params
    strides = p["strides"] or (1,) * len(p["start_indices"])
    cuts = [slice(*cut) for cut in zip(p["start_indices"], p["limit_indices"], strides)]
    return given[0][(*(slice(None),) * extra, *cuts)]


def _rev(eqn: Any, extra: int, given: list[Values]) -> Values:
    return np.flip(given[0], tuple(extra + axis for axis in eqn.params["dimensions"]))


def _reduce_sum(eqn: Any, extra: int, given: list[Values]) -> Values:
    return given[0].sum(axis=tuple(extra + axis for axis in eqn.params["axes"]))


def _concatenate(eqn: Any, extra: int, given: list[Values]) -> Values:
    return np.concatenate(given, eqn.params["dimension"] + extra)


def _stack(eqn: Any, extra: int, given: list[Values]) -> Values:
    return np.stack(given, eqn.params["axis"] + extra)


def _split(eqn: Any, given: list[Any]) -> list[Slope]:
    """The pieces along an axis, as `ravel_pytree` takes a vector apart."""
    axis, sizes = eqn.params["axis"], list(map(int, eqn.params["sizes"]))
    if len(sizes) == 1:
        return given
    pieces = []
    for end, size in zip(np.cumsum(sizes), sizes, strict=True):
        cut = slice(end - size, end)
        take = lambda eqn, extra, v, cut=cut: v[0][(*(slice(None),) * (extra + axis), cut)]  # noqa: E731
        pieces.append(_linear(take)(eqn, given))
    return pieces


def _at_places(eqn: Any, given: list[Any]) -> Slope | None:
    """What is linear in its first argument and picks or adds entries at places given by the others:
    by the operation itself, column after column."""
    x, *places = given
    if any(map(is_slope, places)):
        return None

    def derivative(stack: Values) -> Values:
        # What is filled in from outside does not move with anything.
        params = dict(eqn.primitive.get_bind_params(eqn.params))
        if "fill_value" in params:
            params["fill_value"] = 0.0
        each = [eqn.primitive.bind(jnp.asarray(v), *places, **params) for v in stack]
        return np.stack([np.asarray(v) for v in each])

    def moved(part: Part) -> Part:
        full = columns(part, max(x.low.size, eqn.outvars[0].aval.size))
        return Part(derivative(full.center), derivative(full.radius), True)

    low, high = (np.asarray(bind(eqn, [jnp.asarray(v), *places])[0]) for v in (x.low, x.high))
    return Slope(low, high, mapped(x.parts, moved))


def _reduce_max(eqn: Any, given: list[Any]) -> Slope:
    """The largest entry: its derivative lies between those of the entries that it may be."""
    (x,) = given
    axes = tuple(eqn.params["axes"])

    def largest(part: Part) -> Part:
        full = columns(part, x.low.size)
        behind = tuple(axis + 1 for axis in axes)
        low = (full.center - full.radius).min(axis=behind)
        return between(low, (full.center + full.radius).max(axis=behind), True)

    return Slope(x.low.max(axis=axes), x.high.max(axis=axes), mapped(x.parts, largest))


def _reduce_min(eqn: Any, given: list[Any]) -> Slope:
    return negative(_reduce_max(eqn, [negative(given[0])]))


def _einsum(eqn: Any, extra: tuple[int, int]) -> str:
    """The product of a dot_general, each side behind so many extra axes."""
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
    """Center and radius, the radius infinite where an end is."""

    center: Values
    radius: Values


def _ball(x: Slope) -> _Ball:
    return _Ball(*between(np.asarray(x.low, float), np.asarray(x.high, float), True)[:2])


def _times(spec: str, x: Any, y: Any) -> _Ball:
    """The product of two interval arrays, as center and radius."""

    def dot(a: Values, b: Values) -> Values:
        return np.einsum(spec, a, b, optimize=True)

    def bound(a: Values, b: Values) -> Values:
        loose = dot(np.isinf(a) * 1.0, (b > 0) * 1.0) + dot((a > 0) * 1.0, np.isinf(b) * 1.0)
        finite = dot(np.where(np.isinf(a), 0.0, a), np.where(np.isinf(b), 0.0, b))
        return np.where(loose > 0, np.inf, finite)

    radius = bound(np.abs(x.center), y.radius) + bound(x.radius, np.abs(y.center) + y.radius)
    return _Ball(dot(x.center, y.center), radius)


def _dot_general(eqn: Any, given: list[Any]) -> Slope:
    left, right = (lift(v, tuple(atom.aval.shape)) for v, atom in zip(given, eqn.invars))
    x, y = _ball(left), _ball(right)
    value = _times(_einsum(eqn, (0, 0)), x, y)
    out = eqn.outvars[0].aval.size

    def by(side: Slope, spec: str, times: Callable[[str, Part], _Ball]) -> Slope:
        """The derivative of the product by what one side depends on."""
        wide = lambda part: columns(part, max(side.low.size, out))  # noqa: E731
        parts = mapped(side.parts, lambda part: Part(*times(spec, wide(part)), True))
        return Slope(value.center, value.center, parts)

    by_left = by(left, _einsum(eqn, (1, 0)), lambda spec, part: _times(spec, part, y))
    by_right = by(right, _einsum(eqn, (0, 1)), lambda spec, part: _times(spec, x, part))
    parts = added(by_left, by_right)
    return Slope(value.center - value.radius, value.center + value.radius, parts)


STRUCTURAL: dict[str, Rule] = {
    **same_for({"stop_gradient", "copy", "copy_p"}, _linear(_as_it_is)),
    **same_for({"reshape", "squeeze", "expand_dims"}, _linear(_reshape)),
    "broadcast_in_dim": _linear(_broadcast_in_dim),
    "transpose": _linear(_transpose),
    "slice": _linear(_slice),
    "rev": _linear(_rev),
    "reduce_sum": _linear(_reduce_sum),
    "concatenate": _linear(_concatenate),
    "stack": _linear(_stack),
    "split": _split,
    **same_for({"gather", "dynamic_slice", "cumsum"}, _at_places),
    "reduce_max": _reduce_max,
    "reduce_min": _reduce_min,
    "dot_general": _dot_general,
}
