"""Excursions: a set or a drive that moves in time may touch the response between two samples.

A switch function s of K (`AbstractSet.switches`) that has one sign at two neighbouring samples may
still change it twice between them, where the data in h or K moves by itself: a bound that dips, a
pulse. Let dev bound how far s is from the line between its values s₀ and s₁ at the samples, by chord
arithmetic in t along the line between the states, in the shape 4θ(1−θ) dev (`below_parabola`). So s
keeps its sign where

    4 dev ≤ (√|s₀| + √|s₁|)²,

the discriminant of the parabola; and it changes its sign once only where 4 dev ≤ |s₁ − s₀|, the
slope of the parabola at its ends. The step control rejects a step where this fails by more than a part
of the tolerance. What is smooth in x is left to the samples.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..vi import independent
from .chords import Chord, NoEnclosure, below_parabola, enclose, is_chord
from .evaluations import Visit
from .flow import Flow, slope

_SHARE = 0.1
"""Of the tolerance, as a depth of an excursion that is ignored."""

_SAMPLED = 4.0
"""Safety factor of a deviation that is estimated from samples, where there is no enclosure."""


class ExcursionGuard(eqx.Module):
    """Bounds the excursions of the switch functions within a step.

    - `drive_moves`: h depends on t by itself, not only through x and announced tables;
    - `enclosed`: chord arithmetic knows the switch functions; otherwise it bounds the parameters of K,
      or nothing, and the deviation is estimated from the samples.
    """

    drive_moves: bool = eqx.field(static=True)
    enclosed: bool = eqx.field(static=True)

    def ratio(self, flow: Flow, visits: list[Visit], rtol: Any, atol: Any) -> Any:
        """Return the largest ratio of a deviation to the one that keeps the sign; above 1 a switch
        function may have changed its sign unseen."""
        visits = jax.lax.stop_gradient([Visit(v.t, v.x, v.rate) for v in visits])
        places = [(v.t, v.x, v.rate.z) for v in visits]
        rows = [_switches(flow, *place) for place in places]
        size = jnp.max(jnp.stack([_largest(z) for _, _, z in places]))
        ignored = 4.0 * _SHARE * (atol + rtol * size)
        first = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *places[:-1])
        second = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *places[1:])
        if self.enclosed:
            with below_parabola():
                dev = jax.vmap(lambda p, q: self._deviation(flow, p, q))(first, second)
        else:
            dev = _SAMPLED * _bends([v.t for v in visits], rows)
        s0, s1 = jnp.stack(rows[:-1]), jnp.stack(rows[1:])
        changes = (s0 > 0) != (s1 > 0)
        room = (jnp.sqrt(jnp.abs(s0)) + jnp.sqrt(jnp.abs(s1))) ** 2
        room = jnp.where(changes, jnp.abs(s1 - s0), room)
        ratio = jnp.where(dev <= 0.0, 0.0, 4.0 * dev / (room + ignored))
        # An infinite slack cannot be used up.
        ratio = jnp.where(jnp.isinf(room), 0.0, ratio)
        ratio = jnp.where(jnp.isnan(ratio), jnp.inf, ratio)
        return jnp.max(ratio, initial=0.0)

    def _deviation(self, flow: Flow, p: tuple[Any, Tree, Tree], q: tuple[Any, Tree, Tree]) -> Any:
        """Return how far the switch functions are from straight lines between two samples."""
        t = Chord(p[0], q[0], jnp.zeros_like(p[0]))
        z = _line(p[2], q[2])
        if self.drive_moves:
            x = _line(p[1], q[1])
            bend = _drive(flow, t, x)
            z = jtu.tree_map(
                lambda line, dev: Chord(line.a, line.b, dev), z, bend, is_leaf=is_chord
            )
        s = enclose(lambda t, z: _raveled(flow, t, p[1], z), t, z)
        return s.dev


def guard(flow: Flow, t0: Any, x0: Tree) -> ExcursionGuard | None:
    """Return the guard of a flow; None where neither K nor h depends on t by itself, or where the
    switch functions of K are not known."""
    problem, args = flow.problem, flow.args
    z = problem.zero_control(x0)
    if flow.switches(t0, x0, z) is None:
        return None
    set_moves = not _steady(lambda t: _raveled(flow, t, x0, z), t0)
    drive_moves = not _steady(lambda t: problem.h(t, x0, z, args), t0)
    if not (set_moves or drive_moves):
        return None
    try:
        trial = ExcursionGuard(drive_moves, True)
        jax.eval_shape(lambda t, x, z: trial._deviation(flow, (t, x, z), (t, x, z)), t0, x0, z)
    except NoEnclosure:
        return ExcursionGuard(drive_moves, False)
    return trial


def _steady(fn: Any, t0: Any) -> bool:
    """Whether fn does not depend on t."""
    return independent(fn, t0)


def _raveled(flow: Flow, t: Any, x: Tree, z: Tree) -> jax.Array:
    found = flow.switches(t, x, z)
    assert found is not None
    return found


def _switches(flow: Flow, t: Any, x: Tree, z: Tree) -> jax.Array:
    return _raveled(flow, t, x, z)


def _drive(flow: Flow, t: Chord, x: Tree) -> Tree:
    """Return how far z is from a line because h depends on t."""
    problem, args = flow.problem, flow.args
    start = jtu.tree_map(lambda chord: chord.a, x, is_leaf=is_chord)
    zero = problem.zero_control(start)
    drive = enclose(lambda t, x: problem.h(t, x, zero, args), t, x)
    dev = jtu.tree_map(lambda chord: chord.dev, drive, is_leaf=is_chord)
    if flow.reciprocal is not None:
        return jtu.tree_map(lambda d, r: jnp.abs(d * r), dev, flow.reciprocal)
    if flow.direct and flow.written is None:
        a = slope(problem, flow.operator, t.a, start, args)
        return jtu.tree_map(lambda d, s: jnp.abs(d / s), dev, a)
    return jtu.tree_map(jnp.abs, flow.operator.apply(dev))


def _line(p: Tree, q: Tree) -> Tree:
    return jtu.tree_map(lambda a, b: Chord(a, b, jnp.zeros_like(a)), p, q)


def _largest(tree: Tree) -> Any:
    leaves = [jnp.max(jnp.abs(leaf)) for leaf in jtu.tree_leaves(tree)]
    return jnp.max(jnp.stack(leaves))


def _bends(times: list[Any], rows: list[jax.Array]) -> jax.Array:
    """Return for each gap between neighbours the largest distance of an inner sample from the line
    through the samples beside it."""
    bends = []
    for k in range(1, len(rows) - 1):
        share = (times[k] - times[k - 1]) / (times[k + 1] - times[k - 1])
        bends.append(jnp.abs(rows[k] - (1.0 - share) * rows[k - 1] - share * rows[k + 1]))
    most = jnp.max(jnp.stack(bends), axis=0)
    return jnp.broadcast_to(most, (len(rows) - 1, *most.shape))
