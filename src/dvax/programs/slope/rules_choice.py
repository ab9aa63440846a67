"""The rule of slope arithmetic for selections, such as `jnp.where`.

If the two branches agree wherever the selection switches, the result is continuous there, and its
derivative is that of one branch or of the other. Otherwise it may jump.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..interpreter import Rule, is_real
from .continuity import COMPARISONS, agree, facts, modulus_argument
from .sources import Recorder
from .values import Part, Slope, hull, is_dependent, is_slope, lift, together


def _select(recorder: Recorder | None, eqn: Any, operands: list[Any]) -> Slope | None:
    shape, dtype = eqn.outvars[0].aval.shape, eqn.outvars[0].aval.dtype
    if len(operands) != 3:
        return None
    which, no, yes = operands
    if lift(which, shape).low.dtype != bool:
        return None
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


def _refined(recorder: Recorder, which: Slope, case: Any, is_yes: bool) -> Any:
    """Return a branch where it is selected: the condition is decided, and a value that it compares with
    a constant is on one side of it."""
    if which.source is None or not is_slope(case):
        return case
    known: dict[int, Any] = {}
    for source, value in facts(which.source, is_yes):
        known[source.key] = np.full(source.eqn.outvars[0].aval.shape, value)
        name = source.eqn.primitive.name
        if name in COMPARISONS:
            v, w = source.operands
            above = (name in ("gt", "ge")) == value
            _cut(known, v, w, above)
            _cut(known, w, v, not above)
    return recorder.tightened(recorder.again(case, known))


def _cut(known: dict[int, Any], value: Any, limit: Any, above: bool) -> None:
    """Add to `known` that a value is at least, or at most, a constant."""
    if not is_slope(value) or value.source is None or is_slope(limit):
        return
    limit = np.asarray(limit)
    infinite = np.full(limit.shape, np.inf)
    _intersect(known, value, *((limit, infinite) if above else (-infinite, limit)))
    inner = modulus_argument(value)
    if inner is not None and not above:
        _intersect(known, inner, -limit, limit)


def _intersect(known: dict[int, Any], value: Slope, low: Any, high: Any) -> None:
    """Add to `known` that a value lies between two bounds. Where that is impossible it stays as it is:
    the branch is not selected there."""
    x = known.get(value.source.key, value)
    low, high = np.maximum(x.low, low), np.minimum(x.high, high)
    possible = low <= high
    known[value.source.key] = x._replace(
        low=np.where(possible, low, x.low), high=np.where(possible, high, x.high)
    )


def choice_rules(recorder: Recorder | None) -> dict[str, Rule]:
    """Return the rule, with the recorder that evaluates branches again."""
    return {"select_n": partial(_select, recorder)}


CHOICE = choice_rules(None)
