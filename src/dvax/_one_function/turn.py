"""A turn of a loop as functions, with calls between them.

What a turn changes is carried as one array, as far as functions make it, so that the turn is a chain:
what can be done at once is handed to another thread, which takes longer to wake.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var
from jax.interpreters import partial_eval as pe

from .._jaxpr import bound, values, variables
from .joins import joined
from .marked import as_one
from .packed import is_number, packed, places, unpacked
from .small import is_known, writes
from .within import BRIEF, carried_out

_LONG = 1024
"""Entries of an array up to which it is packed with others, if functions make it: to copy a longer one
once more takes as long as to wake a thread."""


class _Slot(NamedTuple):
    """Where a value lies in an array of several."""

    array: int
    begin: int


class _Level(NamedTuple):
    """What follows from as many calls as are on a way to it, and the calls that it leads to."""

    own: list[Any]
    calls: list[Any]


class Turn:
    """A turn of a loop that begins with `init`, from (what is packed, what is not) to the same after
    it. `fixed` is what the body begins with."""

    def __init__(self, body: ClosedJaxpr, fixed: list[Any], init: list[Any]):
        jaxpr = pe.dce_jaxpr(body.jaxpr, True, instantiate=True)[0]
        carried = jaxpr.invars[len(fixed) :]
        # What comes out as it went in does not change.
        self.moves = [v is not w for v, w in zip(carried, jaxpr.outvars, strict=True)]
        self.still = [x for x, moves in zip(init, self.moves, strict=True) if not moves]
        self.carried, self.results = _those(carried, self.moves), _those(jaxpr.outvars, self.moves)
        known = dict(zip(jaxpr.constvars, body.consts, strict=True))
        known |= dict(zip(jaxpr.invars, fixed, strict=False))
        known |= zip(_those(carried, [not m for m in self.moves]), self.still, strict=True)
        self.free, moving = _at_rest(jaxpr, known)
        self.of_free = {v for eqn in self.free for v in eqn.outvars}
        self.levels = self._by_level(moving)
        made = {v for level in self.levels for eqn in level.own for v in eqn.outvars}
        self.packs = [
            _is_few(v.aval) or (_is_few(v.aval, _LONG) and isinstance(w, Var) and w in made)
            for v, w in zip(self.carried, self.results, strict=True)
        ]
        used = _used(moving) | variables(self.results)
        self._keep({v: value for v, value in known.items() if v in used})

    def _keep(self, still: dict[Any, Any]) -> None:
        """What does not change, as values and an array that begins with a 1."""
        few = {v: x for v, x in still.items() if _is_few(v.aval)}
        large = {v: x for v, x in still.items() if v not in few}
        # Constants that are handed to a function would stop the compiler.
        held = lax.optimization_barrier([packed([jnp.ones(()), *few.values()]), *large.values()])
        self.array: jax.Array = held[0]
        self.known: dict[Any, Any] = dict(zip(large, held[1:], strict=True))
        self.known |= _slots(0, few, 1)

    def _by_level(self, eqns: list[Any]) -> list[_Level]:
        """Each equation as early as what it needs allows, or as late as what needs it does, whichever
        leaves less to hand on."""
        made: dict[Any, int] = {}
        early = []
        for eqn in eqns:
            early.append(max([made.get(v, 0) for v in variables(eqn.invars)], default=0))
            made |= dict.fromkeys(eqn.outvars, early[-1] + 1 if _is_call(eqn) else early[-1])
        # Results are packed by a function, the last one.
        last = max([made.get(v, 0) for v in variables(self.results)], default=0)
        last = max([last, *early])
        levels = [_Level([], []) for _ in range(last + 1)]
        due: dict[Any, int] = {}
        for eqn, level in zip(reversed(eqns), reversed(early), strict=True):
            # What was there before all calls is at hand for any function.
            passed = {v for v in variables(eqn.invars) if made.get(v, 0) > 0}
            if not _is_call(eqn) and _size(passed) <= _size(eqn.outvars):
                level = min([due.get(v, last) for v in eqn.outvars])
            due |= {v: min(due.get(v, last), level) for v in variables(eqn.invars)}
            (levels[level].calls if _is_call(eqn) else levels[level].own).insert(0, eqn)
        return levels

    def together(self, carry: Any) -> tuple[jax.Array, list[Any]]:
        moving = _those(carry, self.moves)
        few = _those(moving, self.packs)
        vector = packed(few) if few else jnp.zeros(0)
        rest = _those(moving, [not p for p in self.packs])
        # As above.
        return lax.optimization_barrier((vector, rest))

    def apart(self, vector: jax.Array, rest: Any) -> list[Any]:
        small = iter(unpacked(vector, [v.aval for v in _those(self.carried, self.packs)]))
        others, still = iter(rest), iter(self.still)
        moving = (next(small if packs else others) for packs in self.packs)
        return [next(moving) if moves else next(still) for moves in self.moves]

    def __call__(self, vector: jax.Array, rest: Any) -> tuple[jax.Array, list[Any]]:
        others = [not p for p in self.packs]
        known = self.known | dict(zip(_those(self.carried, others), rest, strict=True))
        known |= _slots(1, _those(self.carried, self.packs))
        run = _Run(self, known, [self.array, vector])
        *before, last = range(len(self.levels))
        for k in before:
            later = [e for level in self.levels[k + 1 :] for e in (*level.own, *level.calls)]
            run.function(self.levels[k], _used(later) | variables(self.results), [])
        small = _those(self.results, self.packs)
        vector = run.function(self.levels[last], variables(_those(self.results, others)), small)
        return vector, [run.value(v) for v in _those(self.results, others)]


class _Run:
    """The values of a turn as it goes on."""

    def __init__(self, turn: Turn, known: dict[Any, Any], arrays: list[Any]):
        self.turn, self.known, self.arrays = turn, known, arrays
        for eqn in turn.free:
            self._carry_out(eqn)

    def value(self, atom: Any) -> Any:
        if isinstance(atom, Literal):
            return atom.val
        value = self.known[atom]
        return _part(self.arrays, value, atom) if isinstance(value, _Slot) else value

    def _carry_out(self, eqn: Any) -> None:
        found = bound(eqn, list(map(self.value, eqn.invars)))
        self.known |= dict(zip(eqn.outvars, found, strict=True))

    def function(self, level: _Level, wanted: set[Any], results: list[Any]) -> Any:
        """One level: its function, for what is `wanted` of it, and its calls. The `results`, packed."""
        own, wanted = level.own, wanted | _used(level.calls)
        out = [v for eqn in own for v in eqn.outvars if v in wanted]
        vector = self._called(own, out, results) if out or results else jnp.zeros(0)
        for eqn in level.calls:
            self._carry_out(eqn)
        return vector

    def _called(self, own: list[Any], out: list[Any], results: list[Any]) -> Any:
        made = {v for eqn in own for v in eqn.outvars}
        needed = [v for v in _in_order(own, results) if v not in made | self.turn.of_free]
        slots = {v: self.known[v] for v in needed if isinstance(self.known[v], _Slot)}
        which = sorted({0, *(slot.array for slot in slots.values())})
        whole = [v for v in needed if v not in slots]
        few, large = [v for v in out if _is_few(v.aval)], [v for v in out if not _is_few(v.aval)]

        def run(arrays: Any, others: Any) -> Any:
            given = dict(zip(which, arrays, strict=True))
            known = dict(zip(whole, others, strict=True))
            known |= {v: _part(given, slot, v) for v, slot in slots.items()}
            one = arrays[0][0]
            eqns = [*self.turn.free, *own]
            found = iter(carried_out(eqns, known, [*large, *few, *results], one))
            rest, small, end = ([next(found) for _ in vs] for vs in (large, few, results))
            kept = packed(small) if small else None, _joined(end, one) if end else None
            return rest, *kept, [leaf.ravel()[0] for leaf in (*arrays, *others) if leaf.size]

        handed = [self.arrays[k] for k in which], [self.known[v] for v in whole]
        rest, small, end, _ = as_one(run, *handed)
        self.known |= dict(zip(large, rest, strict=True))
        if small is not None:
            self.known |= _slots(len(self.arrays), few)
            self.arrays.append(small)
        return jnp.zeros(0) if end is None else end


def _at_rest(jaxpr: Jaxpr, known: dict[Any, Any]) -> tuple[list[Any], list[Any]]:
    """Equations that need nothing at all, and those that change with the turn. What else there is
    does not, and is carried out once: it is then `known`."""
    free, moving = [], []
    none: dict[Any, Any] = {}
    for eqn in jaxpr.eqns:
        needs = variables(eqn.invars)
        if needs <= none.keys() | known.keys():
            both = none | known
            found = dict(zip(eqn.outvars, bound(eqn, values(both, eqn.invars)), strict=True))
            if needs <= none.keys() and is_known(eqn):
                free.append(eqn)
                none |= found
            else:
                known |= found
        else:
            moving.append(eqn)
    return free, moving


def _is_call(eqn: Any) -> bool:
    """Whether it is done by itself: within a function, to write a part of an array would be to copy it
    all."""
    return not is_known(eqn) or writes(eqn, BRIEF)


def _joined(leaves: list[Any], one: jax.Array) -> jax.Array:
    """All of them packed, the large ones by loops of their own."""
    parts: list[jax.Array] = []
    few: list[Any] = []
    for value in leaves:
        if jnp.size(value) <= BRIEF:
            few.append(value)
            continue
        parts += [packed(few)] if few else []
        parts.append(packed([value]))
        few = []
    parts += [packed(few)] if few else []
    return joined(parts, 0, one) if len(parts) > 1 else parts[0]


def _part(arrays: Any, slot: _Slot, v: Any) -> Any:
    part = arrays[slot.array][slot.begin : slot.begin + places(v.aval)]
    return unpacked(part, [v.aval])[0]


def _slots(array: int, variables: Any, begin: int = 0) -> dict[Any, _Slot]:
    found = {}
    for v in variables:
        found[v] = _Slot(array, begin)
        begin += places(v.aval)
    return found


def _those(leaves: Any, wanted: list[bool]) -> list[Any]:
    return [leaf for leaf, is_wanted in zip(leaves, wanted, strict=True) if is_wanted]


def _is_few(aval: Any, most: int = BRIEF) -> bool:
    return is_number(aval) and math.prod(aval.shape) <= most


def _size(variables: Any) -> int:
    return sum(v.aval.size for v in variables)


def _used(eqns: list[Any]) -> set[Any]:
    return {v for eqn in eqns for v in variables(eqn.invars)}


def _in_order(eqns: list[Any], results: list[Any]) -> list[Any]:
    """The variables that they need, each once."""
    atoms = [*(atom for eqn in eqns for atom in eqn.invars), *results]
    return list(dict.fromkeys(atom for atom in atoms if isinstance(atom, Var)))
