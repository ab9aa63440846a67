"""The rules of slope arithmetic for operations that move entries about or add them up."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .._jaxpr import bound
from .slope import (
    MOST,
    Part,
    Slope,
    TooLarge,
    Values,
    added,
    between,
    columns,
    entries,
    is_slope,
    lift,
)
from .slope_entrywise import Rule


def _moving(fn: Callable[[Any, Values, int], Values]) -> Rule:
    """What only moves entries about, or adds them up; `fn(params, array, extra)` does so behind the
    first `extra` axes."""

    def rule(eqn: Any, given: list[Any]) -> Slope:
        x = given[0]
        aval = eqn.outvars[0].aval
        # A reshape may permute the axes first.
        permuted = eqn.primitive.name == "reshape" and eqn.params.get("dimensions") is not None
        same = aval.size == x.low.size and not permuted
        parts = {}
        for k, part in x.parts.items():
            keeps = same and not part.full and eqn.primitive.name in _IN_ORDER
            if keeps:
                parts[k] = Part(
                    part.center.reshape(aval.shape), part.radius.reshape(aval.shape), False
                )
                continue
            if entries(part) * max(x.low.size, aval.size) > MOST:
                raise TooLarge
            full = columns(part, entries(part))
            parts[k] = Part(fn(eqn, full.center, 1), fn(eqn, full.radius, 1), True)
        return Slope(fn(eqn, x.low, 0), fn(eqn, x.high, 0), parts)

    return rule


_IN_ORDER = {"reshape", "squeeze", "expand_dims", "broadcast_in_dim", "copy", "copy_p"}


def _reshape(eqn: Any, v: Values, extra: int) -> Values:
    order = eqn.params.get("dimensions") if eqn.primitive.name == "reshape" else None
    if order is not None:
        v = v.transpose(*range(extra), *(extra + axis for axis in order))
    return v.reshape((*v.shape[:extra], *eqn.outvars[0].aval.shape))


def _broadcast_in_dim(eqn: Any, v: Values, extra: int) -> Values:
    shape = eqn.outvars[0].aval.shape
    wide = [1] * len(shape)
    for axis, place in enumerate(eqn.params["broadcast_dimensions"]):
        wide[place] = v.shape[extra + axis]
    return np.broadcast_to(v.reshape((*v.shape[:extra], *wide)), (*v.shape[:extra], *shape))


def _transpose(eqn: Any, v: Values, extra: int) -> Values:
    order = [extra + axis for axis in eqn.params["permutation"]]
    return v.transpose(*range(extra), *order)


def _slice(eqn: Any, v: Values, extra: int) -> Values:
    p = eqn.params
    strides = p["strides"] or (1,) * len(p["start_indices"])
    cuts = [slice(*cut) for cut in zip(p["start_indices"], p["limit_indices"], strides)]
    return v[(*(slice(None),) * extra, *cuts)]


def split(eqn: Any, given: list[Any]) -> list[Slope]:
    """The pieces along an axis, as `ravel_pytree` takes a vector apart."""
    (x,), axis, sizes = given, eqn.params["axis"], eqn.params["sizes"]
    if len(sizes) == 1:
        return [x]
    pieces, end = [], 0
    for size in map(int, sizes):
        piece = _moving(_cut(axis, end, end + size))(eqn, given)
        assert piece is not None
        pieces.append(piece)
        end += size
    return pieces


def _cut(axis: int, start: int, end: int) -> Callable[[Any, Values, int], Values]:
    return lambda eqn, v, extra: v[(*(slice(None),) * (extra + axis), slice(start, end))]


def _rev(eqn: Any, v: Values, extra: int) -> Values:
    return np.flip(v, tuple(extra + axis for axis in eqn.params["dimensions"]))


def _reduce_sum(eqn: Any, v: Values, extra: int) -> Values:
    return v.sum(axis=tuple(extra + axis for axis in eqn.params["axes"]))


def _reduce_max(eqn: Any, given: list[Any]) -> Slope:
    """The largest entry: its derivative lies between those of the entries that it may be."""
    (x,) = given
    axes = tuple(eqn.params["axes"])
    parts = {}
    for k, part in x.parts.items():
        full = columns(part, entries(part))
        behind = tuple(axis + 1 for axis in axes)
        low = (full.center - full.radius).min(axis=behind)
        high = (full.center + full.radius).max(axis=behind)
        parts[k] = between(low, high, True)
    return Slope(x.low.max(axis=axes), x.high.max(axis=axes), parts)


def _reduce_min(eqn: Any, given: list[Any]) -> Slope:
    flip = lambda x: Slope(  # noqa: E731
        -x.high, -x.low, {k: p._replace(center=-p.center) for k, p in x.parts.items()}
    )
    return flip(_reduce_max(eqn, [flip(given[0])]))


def _concatenate(eqn: Any, given: list[Any]) -> Slope:
    x = [lift(v, tuple(atom.aval.shape)) for v, atom in zip(given, eqn.invars)]
    return _joined(x, eqn.params["dimension"], eqn.outvars[0].aval.size)


def _stack(eqn: Any, given: list[Any]) -> Slope:
    axis = eqn.params["axis"]
    x = [lift(v, tuple(atom.aval.shape)) for v, atom in zip(given, eqn.invars)]
    return _joined([_with_axis(v, axis) for v in x], axis, eqn.outvars[0].aval.size)


def _with_axis(x: Slope, axis: int) -> Slope:
    wide = lambda v, extra: np.expand_dims(v, axis + extra)  # noqa: E731
    parts = {
        k: Part(wide(p.center, p.full), wide(p.radius, p.full), p.full) for k, p in x.parts.items()
    }
    return Slope(wide(x.low, 0), wide(x.high, 0), parts)


def _joined(x: list[Slope], axis: int, total: int) -> Slope:
    parts = {}
    for k in {k: None for v in x for k in v.parts}:
        size = next(entries(v.parts[k]) for v in x if k in v.parts)
        if size * total > MOST:
            raise TooLarge
        pieces = []
        for v in x:
            blank = np.zeros((size, *v.low.shape))
            pieces.append(columns(v.parts[k], size) if k in v.parts else Part(blank, blank, True))
        parts[k] = Part(
            np.concatenate([p.center for p in pieces], axis + 1),
            np.concatenate([p.radius for p in pieces], axis + 1),
            True,
        )
    low, high = np.concatenate([v.low for v in x], axis), np.concatenate([v.high for v in x], axis)
    return Slope(low, high, parts)


def _by_operation(eqn: Any, given: list[Any]) -> Slope | None:
    """What is linear in its first argument and picks or adds entries at places given by the others:
    by the operation itself, column after column."""
    if any(map(is_slope, given[1:])):
        return None
    x, rest = given[0], given[1:]

    def move(v: Values) -> Values:
        return np.asarray(bound(eqn, [jnp.asarray(v), *rest])[0])

    def moved_slopes(stack: Values) -> Values:
        # What is filled in from outside does not move with anything.
        params = dict(eqn.primitive.get_bind_params(eqn.params))
        if "fill_value" in params:
            params["fill_value"] = 0.0
        each = [eqn.primitive.bind(jnp.asarray(v), *rest, **params) for v in stack]
        return np.stack([np.asarray(v) for v in each])

    parts = {}
    for k, part in x.parts.items():
        if entries(part) * max(x.low.size, eqn.outvars[0].aval.size) > MOST:
            raise TooLarge
        full = columns(part, entries(part))
        parts[k] = Part(moved_slopes(full.center), moved_slopes(full.radius), True)
    return Slope(move(x.low), move(x.high), parts)


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

    def through(parts: dict[int, Part], spec: str, other: _Ball, first: bool) -> dict[int, Part]:
        moved = {}
        for k, part in parts.items():
            if entries(part) * max(part.center.size, out) > MOST:
                raise TooLarge
            full = columns(part, entries(part))
            moved[k] = Part(
                *_times(spec, full, other) if first else _times(spec, other, full), True
            )
        return moved

    by_left = through(left.parts, _einsum(eqn, (1, 0)), y, True)
    by_right = through(right.parts, _einsum(eqn, (0, 1)), x, False)
    parts = added(by_left, by_right)
    return Slope(value.center - value.radius, value.center + value.radius, parts)


MOVING: dict[str, Rule] = {
    "stop_gradient": _moving(lambda eqn, v, extra: v),
    "copy": _moving(lambda eqn, v, extra: v),
    "copy_p": _moving(lambda eqn, v, extra: v),
    "reshape": _moving(_reshape),
    "squeeze": _moving(_reshape),
    "expand_dims": _moving(_reshape),
    "broadcast_in_dim": _moving(_broadcast_in_dim),
    "transpose": _moving(_transpose),
    "slice": _moving(_slice),
    "rev": _moving(_rev),
    "reduce_sum": _moving(_reduce_sum),
    "reduce_max": _reduce_max,
    "reduce_min": _reduce_min,
    "stack": _stack,
    "concatenate": _concatenate,
    "gather": _by_operation,
    "dynamic_slice": _by_operation,
    "cumsum": _by_operation,
    "dot_general": _dot_general,
}
