"""Which intermediate arrays of a function are worth keeping.

XLA computes an intermediate array again wherever it is used, rather than write it down and read it
again; a long chain of operations that leads to several results is then carried out several times. A
branch is what it does not see through: what a branch returns is written down.
"""

import math
from typing import Any

from jax.extend.core import Literal, Var

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
    """Variables to be kept, those that others lead to after these."""
    joined = _joined(eqns, results)
    cost = _costs(eqns, set())
    ends: dict[Any, set[Any]] = {v: {v} for v in results}
    chosen: set[Any] = set()
    for eqn in reversed(eqns):
        (v, *_) = eqn.outvars
        own = set().union(*(ends.get(w, set()) for w in eqn.outvars))
        if not own:
            continue
        if _written(eqn):
            own = {v}
        elif math.prod(v.aval.shape) > brief and (
            (len(own) > 1 and cost[v] >= _WORTH) or (v in joined and own != {v})
        ):
            chosen.add(v)
            own = {v}
        for w in _variables(eqn.invars):
            ends[w] = ends.get(w, set()) | ({w} if is_sum(eqn) else own)
    # With all that is chosen before it kept, one may cost little.
    kept: set[Any] = set()
    cost = _costs(eqns, kept, chosen, joined)
    stage: dict[Any, int] = {}
    stages: list[list[Any]] = []
    for eqn in eqns:
        at = max([stage.get(w, 0) for w in _variables(eqn.invars)], default=0)
        stage |= dict.fromkeys(eqn.outvars, at)
        for v in kept.intersection(eqn.outvars):
            if at == len(stages):
                stages.append([])
            stages[at].append(v)
            stage[v] = at + 1
    return stages


def _joined(eqns: list[Any], results: set[Any]) -> set[Any]:
    """Arrays put together of parts, in their last shape."""
    found, into = set(), set()
    for eqn in eqns:
        if is_joined(eqn):
            found.add(eqn.outvars[0])
        elif eqn.primitive.name == "reshape" and found & _variables(eqn.invars):
            found.add(eqn.outvars[0])
            into.add(eqn.invars[0])
    others = results | {
        v for e in eqns if e.primitive.name != "reshape" for v in _variables(e.invars)
    }
    return found - (into - others)


def _costs(eqns: list[Any], kept: set[Any], chosen: Any = (), joined: Any = ()) -> dict[Any, float]:
    """What it costs to compute an entry of each, from what is kept; of the `chosen`, those that cost
    enough are kept."""
    cost: dict[Any, float] = {}
    for eqn in eqns:
        own = _COSTS.get(eqn.primitive.name, 1.0) + sum(
            cost.get(w, 0.0) for w in _variables(eqn.invars)
        )
        own = 0.0 if _written(eqn) else own
        for v in eqn.outvars:
            if v in chosen and (own >= _WORTH or v in joined):
                kept.add(v)
            cost[v] = 0.0 if v in kept else own
    return cost


def _written(eqn: Any) -> bool:
    return math.isinf(_COSTS.get(eqn.primitive.name, 1.0)) or is_sum(eqn)


def _variables(atoms: Any) -> set[Any]:
    return {atom for atom in atoms if isinstance(atom, Var) and not isinstance(atom, Literal)}
