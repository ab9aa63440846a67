"""The rules of slope arithmetic for selections: `jnp.where`, `jnp.select` and `jax.lax.cond`.

If the two branches agree wherever the selection switches, the result is continuous there, and its
derivative is that of one branch or of the other. Otherwise it may jump.
"""

import functools
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..interpreter import Rule, is_real
from .alignment import Axes, own_axes
from .continuity import agree, facts, modulus_argument, stripped
from .rules_programs import Run
from .sources import COMPARISONS, Known, Recorder, relation_of
from .values import Part, Slope, columns, hull, is_dependent, is_slope, lift, mapped, together


def _select(
    recorder: Recorder | None, run: Run, eqn: Any, operands: list[Any]
) -> Slope | list[Any] | None:
    shape, dtype = eqn.outvars[0].aval.shape, eqn.outvars[0].aval.dtype
    if eqn.invars[0].aval.dtype != bool:
        which, *cases = operands
        conditions = _conditions(which, len(cases))
        if conditions is None:
            return None
        program = _nested(len(cases), np.shape(conditions[0]), shape, str(dtype))
        return run(program, [*conditions, *cases])
    which, no, yes = operands
    continuous = False
    if recorder is not None and is_slope(which) and is_real(eqn.outvars[0].aval):
        eps = float(jnp.finfo(dtype).eps)
        continuous = agree(which, no, yes, shape, eps)
        no = _refined(recorder, which, no, False)
        yes = _refined(recorder, which, yes, True)
    which, no, yes = (lift(v, shape) for v in (which, no, yes))
    is_decided = which.low == which.high
    pick = lambda a, b, other: np.where(is_decided, np.where(which.low, b, a), other)  # noqa: E731
    parts = {}
    for k, (a, b, by_choice) in together([no, yes, which]).items():
        both = hull(a, b)
        radius = both.radius
        if not continuous:
            radius = np.where(is_dependent(by_choice), np.inf, radius)
        center = pick(a.center, b.center, both.center)
        parts[k] = Part(center, pick(a.radius, b.radius, radius), a.full)
    low = pick(no.low, yes.low, np.minimum(no.low, yes.low))
    return Slope(low, pick(no.high, yes.high, np.maximum(no.high, yes.high)), parts)


def _conditions(index: Any, count: int) -> list[Any] | None:
    """Return conditions of which the first that holds has this index, and where none does it is 0. None
    if they are not known."""
    if not is_slope(index):
        return [np.asarray(index) == k for k in range(count)]
    if count == 2 and index.source is not None and index.source.eqn is not None:
        inner = index.source.operands[0]
        converts = index.source.eqn.primitive.name == "convert_element_type"
        if converts and is_slope(inner) and inner.low.dtype == bool:
            # The index of `lax.cond` under `jax.vmap`.
            return [np.zeros(np.shape(inner.low), bool), inner]
    source = None if index.source is None else stripped(index.source)
    if source is None or source.eqn is None or source.eqn.primitive.name != "argmax":
        return None
    rows = source.operands[0]
    rows = rows.source if is_slope(rows) else None
    if rows is None or rows.eqn is None or rows.eqn.primitive.name != "stack":
        return None
    (axis,) = source.eqn.params["axes"]
    along = rows.eqn.params["axis"] == axis and len(rows.operands) == count
    return list(rows.operands) if along else None


@functools.lru_cache(512)
def _nested(count: int, of_condition: tuple[int, ...], shape: tuple[int, ...], dtype: str) -> Any:
    """Return the program that selects the case of the first condition that holds, the first case where
    none does."""
    conditions = [jax.ShapeDtypeStruct(of_condition, bool)] * count
    cases = [jax.ShapeDtypeStruct(shape, dtype)] * count

    def select(*operands: Any) -> Any:
        chosen = operands[count]
        for k in reversed(range(count)):
            chosen = lax.select_n(operands[k], chosen, operands[count + k])
        return chosen

    return jax.make_jaxpr(select)(*conditions, *cases)


def _first(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the index of the first of Boolean values that is true, 0 if none is."""
    (x,), (axis,) = operands, eqn.params["axes"]
    if x.low.dtype != bool:
        return None
    last = x.low.shape[axis] - 1
    surely, possibly = x.low.any(axis), x.high.any(axis)
    low = np.where(surely, x.high.argmax(axis), 0)
    latest = np.where(possibly, last - np.flip(x.high, axis).argmax(axis), 0)
    high = np.where(surely, x.low.argmax(axis), latest)

    def jumping(part: Part) -> Part:
        depends = is_dependent(columns(part, x.low.size)).any(axis + 1)
        radius = np.where(depends & (low != high), np.inf, 0.0)
        return Part(np.zeros_like(radius), radius, True)

    dtype = eqn.outvars[0].aval.dtype
    return Slope(low.astype(dtype), high.astype(dtype), mapped(x.parts, jumping))


def _refined(recorder: Recorder, which: Slope, case: Any, is_yes: bool) -> Any:
    """Return a branch where it is selected: the condition is decided, and a value that it compares with
    a constant is on one side of it."""
    if which.source is None or not is_slope(case):
        return case
    known: dict[Any, Known] = {}
    for source, value, axes in facts(which.source, is_yes, own_axes(which.low.shape)):
        known[source.key] = Known(np.full(source.eqn.outvars[0].aval.shape, value), axes)
        name, relation = source.eqn.primitive.name, relation_of(source)
        if relation is not None:
            known[relation[0]] = Known(value == relation[1], axes)
        if name in COMPARISONS:
            v, w = source.operands
            above = (name in ("gt", "ge")) == value
            _cut(known, v, w, above, axes)
            _cut(known, w, v, not above, axes)
    whole = own_axes(case.low.shape) if which.low.shape in ((), case.low.shape) else None
    return recorder.tightened(recorder.again(case, known, whole))


def _cut(known: dict[Any, Known], value: Any, limit: Any, above: bool, axes: Axes) -> None:
    """Add to `known` that a value is at least, or at most, a constant."""
    if not is_slope(value) or value.source is None or is_slope(limit):
        return
    limit = np.asarray(limit)
    if limit.shape not in ((), value.low.shape):
        # The entries of the limit bound one number where their own condition holds.
        return
    infinite = np.full(limit.shape, np.inf)
    _intersect(known, value, *((limit, infinite) if above else (-infinite, limit)), axes)
    inner = modulus_argument(value)
    if inner is not None and not above:
        _intersect(known, inner, -limit, limit, axes)


def _intersect(known: dict[Any, Known], value: Slope, low: Any, high: Any, axes: Axes) -> None:
    """Add to `known` that a value lies between two bounds. Where that is impossible it stays as it is:
    the branch is not selected there."""
    x = value
    if (fact := known.get(value.source.key)) is not None:
        if fact.axes != axes:
            return
        x = fact.value
    low, high = np.maximum(x.low, low), np.minimum(x.high, high)
    possible = low <= high
    between = x._replace(low=np.where(possible, low, x.low), high=np.where(possible, high, x.high))
    known[value.source.key] = Known(between, axes)


def choice_rules(recorder: Recorder | None, run: Run) -> dict[str, Rule]:
    """Return the rules, with the recorder that evaluates branches again, and the function that
    interprets a program."""
    return {"select_n": partial(_select, recorder, run), "argmax": _first}


CHOICE = choice_rules(None, lambda program, inputs: inputs)
