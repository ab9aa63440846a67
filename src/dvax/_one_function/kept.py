"""Which intermediate arrays of a function are worth keeping.

XLA computes an intermediate array again wherever it is used, rather than write it down and read it
again; a long chain of operations that leads to several results is then carried out several times. A
branch is what it does not see through: what a branch returns is written down.
"""

import math
from typing import Any

from .._jaxpr import variables
from .joins import is_joined
from .sums import is_sum

_WORTH = 8.0
"""Additions that cost more than to write a number down and read it again."""

_COSTS = {
    **dict.fromkeys("div sqrt rsqrt rem concatenate stack".split(), 4.0),
    **dict.fromkeys("rev gather transpose complex".split(), 2.0),
    **dict.fromkeys(
        "slice reshape squeeze broadcast_in_dim convert_element_type copy".split(), 0.5
    ),
    **dict.fromkeys("cond while scan".split(), math.inf),
}
"""Of operations, in additions; what is infinite is written down anyway."""


def worth_keeping(eqns: list[Any], results: set[Any], brief: int) -> list[list[Any]]:
    """Variables of more entries than `brief` to be kept, those that others lead to after these."""
    kept = _kept(eqns, _chosen(eqns, results, brief), _joined(eqns, results))
    stage: dict[Any, int] = {}
    stages: list[list[Any]] = []
    for eqn in eqns:
        at = max([stage.get(w, 0) for w in variables(eqn.invars)], default=0)
        stage |= dict.fromkeys(eqn.outvars, at)
        for v in eqn.outvars:
            if v in kept:
                stages += [[]] if at == len(stages) else []
                stages[at].append(v)
                stage[v] = at + 1
    return stages


def _chosen(eqns: list[Any], results: set[Any], brief: int) -> set[Any]:
    """What leads to several things that are written down, and costs much if nothing before it is kept;
    and what is put together of parts on the way to anything."""
    joined, cost = _joined(eqns, results), _costs(eqns, set())
    ends: dict[Any, set[Any]] = {v: {v} for v in results}
    chosen: set[Any] = set()
    for eqn in reversed(eqns):
        v = eqn.outvars[0]
        own = set().union(*(ends.get(w, set()) for w in eqn.outvars))
        if own and _is_written(eqn):
            own = {v}
        elif own and math.prod(v.aval.shape) > brief:
            often = len(own) > 1 and cost[v] >= _WORTH
            if often or (v in joined and own != {v}):
                chosen.add(v)
                own = {v}
        for w in variables(eqn.invars):
            ends[w] = ends.get(w, set()) | ({w} if own and is_sum(eqn) else own)
    return chosen


def _joined(eqns: list[Any], results: set[Any]) -> set[Any]:
    """Arrays put together of parts, in their last shape."""
    found, into = set(), set()
    for eqn in eqns:
        if is_joined(eqn):
            found.add(eqn.outvars[0])
        elif eqn.primitive.name == "reshape" and found & variables(eqn.invars):
            found.add(eqn.outvars[0])
            into.add(eqn.invars[0])
    others = results | {
        v for e in eqns if e.primitive.name != "reshape" for v in variables(e.invars)
    }
    return found - (into - others)


def _kept(eqns: list[Any], chosen: set[Any], joined: set[Any]) -> set[Any]:
    """Of the chosen, those that cost much even if the others before them are kept."""
    kept: set[Any] = set()
    for v in [v for eqn in eqns for v in eqn.outvars if v in chosen]:
        if v in joined or _costs(eqns, kept)[v] >= _WORTH:
            kept.add(v)
    return kept


def _costs(eqns: list[Any], kept: set[Any]) -> dict[Any, float]:
    """What it costs to compute an entry of each, from what is kept."""
    cost: dict[Any, float] = {}
    for eqn in eqns:
        own = _COSTS.get(eqn.primitive.name, 1.0)
        own += sum(cost.get(w, 0.0) for w in variables(eqn.invars))
        written = _is_written(eqn)
        cost |= {v: 0.0 if written or v in kept else own for v in eqn.outvars}
    return cost


def _is_written(eqn: Any) -> bool:
    return math.isinf(_COSTS.get(eqn.primitive.name, 1.0)) or is_sum(eqn)
