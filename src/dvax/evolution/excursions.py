"""Data that moves in time may do more between two samples of a step than the samples show.

Two things are bounded by linear enclosures in t, in the shape 4θ(1−θ) dev (`below_parabola`):

*Excursions.* A switch function s of K (`AbstractSet.switches`) with one sign at two neighbouring
samples may change it twice between them: a bound that dips, a pulse in h. It keeps its sign where

    4 dev ≤ (√|s₀| + √|s₁|)²,

the discriminant of the parabola; and it changes its sign once only where 4 dev ≤ |s₁ − s₀|, the slope
of the parabola at its ends.

*Pulses.* A function q of time (f and h at the state of the step, the parameters of K) may leave its
samples and come back. The step is short enough where

    dev ≤ V/4,    V = the largest variation between neighbouring samples so far, halved every 64th of
                  the run.

A wave that the steps resolve has shown its size and meets this by a wide margin; a pulse that lies
between two samples does not. A jump is no such size, nor what the data did at the start of the run.

Both hold up to a part of the tolerance. What is smooth in x is left to the samples.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..programs.enclosure import LinearEnclosure, NoEnclosure, below_parabola, enclose, is_enclosure
from ..vi import independent
from .evaluations import Evaluation
from .flow import Flow, slope

WATCH = 1e-6
"""Share of the run below which a step is short enough to go by its samples alone."""

_SHARE = 0.1
"""Of the tolerance, as a depth of an excursion that is ignored."""

_SAMPLED = 4.0
"""Safety factor of a deviation that is estimated from samples, where there is no enclosure."""

_VARIATION = 0.25
"""Of the largest variation seen, as a deviation that may lie between two samples."""

_HALVINGS = 64.0
"""How often the largest variation is halved in a run. At the crest of a wave as long as the run, V is
still a tenth of the variation beside it."""


class Look(NamedTuple):
    """What one step shows: `excursion`(size) is the largest ratio of a deviation to the one that keeps
    a sign, given the size that is ignored; `rates` and `laws` the deviations of the data of f, and of
    h and K, beyond a quarter of the variation seen; `variation` the largest one seen so far."""

    excursion: Any
    law_size: Any
    rates: Any
    laws: Any
    variation: Tree

    def ratio(self, rtol: Any, atol: Any, rate_tolerance: Any) -> Any:
        """Return by how much the step is too long: above 1 it may hide something."""
        ignored = _SHARE * (atol + rtol * self.law_size)
        worst = jnp.maximum(self.excursion(4.0 * ignored), self.laws / ignored)
        worst = jnp.maximum(worst, self.rates / (_SHARE * rate_tolerance))
        return jnp.where(jnp.isnan(worst), jnp.inf, worst)


class ExcursionGuard(eqx.Module):
    """Looks between the samples of a step at data that depends on t by itself, not through announced
    tables alone.

    - `switches`: K or h moves, and the switch functions of K are known;
    - `rates`, `laws`: f, and h or K, depend on t by themselves and can be enclosed;
    - `enclosed`: so can the switch functions; otherwise their deviation is estimated from the samples.
    """

    switches: bool = eqx.field(static=True)
    rates: bool = eqx.field(static=True)
    laws: bool = eqx.field(static=True)
    enclosed: bool = eqx.field(static=True)

    def start(self, flow: Flow, t0: Any, x0: Tree) -> Tree:
        """Return the variation before the first step: none."""
        data = jax.eval_shape(lambda t: self._data(flow, t, x0, flow.problem.zero_control(x0)), t0)
        return jtu.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), data)

    def look(self, flow: Flow, evaluations: list[Evaluation], variation: Tree, share: Any) -> Look:
        """Return what the samples of a step leave open, which is this `share` of the run."""
        places, variation = jax.lax.stop_gradient(
            ([(v.t, v.x, v.rate.y, v.rate.z) for v in evaluations], variation)
        )
        first = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *places[:-1])
        second = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *places[1:])
        zero = jnp.zeros_like(evaluations[0].t)
        rates, laws = zero, zero
        if self.rates or self.laws:
            with below_parabola():
                moved, dev = jax.vmap(lambda p, q: self._pulses(flow, p, q))(first, second)
            most = lambda tree: jtu.tree_map(lambda leaf: jnp.max(leaf, axis=0), tree)  # noqa: E731
            fades = 0.5 ** (_HALVINGS * share)
            variation = jtu.tree_map(lambda v, m: jnp.maximum(fades * v, m), variation, most(moved))
            over = jtu.tree_map(
                lambda d, v: jnp.max(d - _VARIATION * v, initial=0.0), most(dev), variation
            )
            rates, laws = (_largest(part) if part else zero for part in over)

        def excursion(ignored: Any) -> Any:
            return self._excursion(flow, places, first, second, ignored) if self.switches else zero

        # Of y and not of z: an entry far outside K is where it is at the bound.
        size = _largest([jnp.abs(leaf) for p in places for leaf in jtu.tree_leaves(p[2])])
        return Look(excursion, size, rates, laws, variation)

    def _data(self, flow: Flow, t: Any, x: Tree, u: Tree) -> tuple[list[Any], list[Any]]:
        """The data of f, and that of h and K, as functions of t alone."""
        problem, args = flow.problem, flow.args
        rates = jtu.tree_leaves(problem.f(t, x, u, args)) if self.rates else []
        if not self.laws:
            return rates, []
        parameters = eqx.filter(problem.set_at(t, args), eqx.is_inexact_array)
        return rates, jtu.tree_leaves((problem.h(t, x, u, args), parameters))

    def _pulses(self, flow: Flow, p: tuple, q: tuple) -> tuple[Tree, Tree]:
        """Return how far the data moves from one sample to the next, and how far it may be from the
        line between."""
        t = LinearEnclosure(p[0], q[0], jnp.zeros_like(p[0]))
        # Half way: a factor that is zero at one of the samples hides what it multiplies.
        x, y = jtu.tree_map(lambda a, b: 0.5 * (a + b), (p[1], p[2]), (q[1], q[2]))
        u = flow.operator.inverse(y)
        data = enclose(lambda t: self._data(flow, t, x, u), t)
        # A bound at infinity does not move, and a jump is no measure of what moves smoothly.
        moved = jtu.tree_map(
            lambda c: jnp.where((c.a == c.b) | jnp.isinf(c.dev), 0.0, jnp.abs(c.b - c.a)), data,
            is_leaf=is_enclosure,
        )  # fmt: skip
        dev = jtu.tree_map(
            lambda c: jnp.where((c.a == c.b) & jnp.isinf(c.a), 0.0, c.dev),
            data,
            is_leaf=is_enclosure,
        )
        return moved, dev

    def _excursion(self, flow: Flow, places: Any, first: Any, second: Any, ignored: Any) -> Any:
        """Return the largest ratio of a deviation to the one that keeps the sign."""
        rows = [_raveled(flow, t, x, z) for t, x, _, z in places]
        if self.enclosed:
            with below_parabola():
                dev = jax.vmap(lambda p, q: self._deviation(flow, p, q))(first, second)
        else:
            dev = _SAMPLED * _bends([place[0] for place in places], rows)
        s0, s1 = jnp.stack(rows[:-1]), jnp.stack(rows[1:])
        changes = (s0 > 0) != (s1 > 0)
        room = (jnp.sqrt(jnp.abs(s0)) + jnp.sqrt(jnp.abs(s1))) ** 2
        room = jnp.where(changes, jnp.abs(s1 - s0), room)
        ratio = jnp.where(dev <= 0.0, 0.0, 4.0 * dev / (room + ignored))
        # An infinite slack cannot be used up.
        ratio = jnp.where(jnp.isinf(room), 0.0, ratio)
        return jnp.max(ratio, initial=0.0)

    def _deviation(self, flow: Flow, p: tuple, q: tuple) -> Any:
        """Return how far the switch functions are from straight lines between two samples."""
        t = LinearEnclosure(p[0], q[0], jnp.zeros_like(p[0]))
        bend = _drive(flow, t, p[1])
        z = jtu.tree_map(LinearEnclosure, p[3], q[3], bend)
        return enclose(lambda t, z: _raveled(flow, t, p[1], z), t, z).dev


def guard(flow: Flow, t0: Any, x0: Tree) -> ExcursionGuard | None:
    """Return the guard of a flow; None where nothing depends on t by itself."""
    problem, args = flow.problem, flow.args
    z = problem.zero_control(x0)
    known = flow.switches(t0, x0, z)
    trial = ExcursionGuard(known is not None and known.size > 0, True, True, True)
    steady = lambda fn: independent(fn, t0)  # noqa: E731
    rates = not steady(lambda t: problem.f(t, x0, z, args))
    laws = not steady(lambda t: trial._data(flow, t, x0, z)[1])
    trial = dataclasses.replace(trial, switches=trial.switches and laws, rates=rates, laws=laws)

    def works(look: Any) -> bool:
        try:
            jax.eval_shape(look, t0, x0, z)
        except NoEnclosure:
            return False
        return True

    place = lambda t, x, z: (t, x, z, z)  # noqa: E731
    for name in ("rates", "laws"):
        alone = ExcursionGuard(False, name == "rates", name == "laws", True)
        if getattr(trial, name) and not works(
            lambda *p, alone=alone: alone._pulses(flow, place(*p), place(*p))
        ):
            trial = dataclasses.replace(trial, **{name: False})
    if trial.switches and not works(lambda *p: trial._deviation(flow, place(*p), place(*p))):
        trial = dataclasses.replace(trial, enclosed=False)
    return trial if trial.switches or trial.rates or trial.laws else None


def _raveled(flow: Flow, t: Any, x: Tree, z: Tree) -> jax.Array:
    found = flow.switches(t, x, z)
    assert found is not None
    return found


def _drive(flow: Flow, t: LinearEnclosure, x: Tree) -> Tree:
    """Return how far z may be from a line because h depends on t."""
    problem, args = flow.problem, flow.args
    zero = problem.zero_control(x)
    drive = enclose(lambda t: problem.h(t, x, zero, args), t)
    dev = jtu.tree_map(lambda line: line.dev, drive, is_leaf=is_enclosure)
    if flow.reciprocal is not None:
        return jtu.tree_map(lambda d, r: jnp.abs(d * r), dev, flow.reciprocal)
    if flow.direct and flow.small_box is None:
        a = slope(problem, flow.operator, t.a, x, args)
        return jtu.tree_map(lambda d, s: jnp.abs(d / s), dev, a)
    return jtu.tree_map(jnp.abs, flow.operator.apply(dev))


def _largest(tree: Any) -> Any:
    return jnp.max(jnp.stack([jnp.max(leaf, initial=0.0) for leaf in jtu.tree_leaves(tree)]))


def _bends(times: list[Any], rows: list[jax.Array]) -> jax.Array:
    """Return for each gap between neighbours the largest distance of an inner sample from the line
    through the samples beside it."""
    bends = []
    for k in range(1, len(rows) - 1):
        share = (times[k] - times[k - 1]) / (times[k + 1] - times[k - 1])
        bends.append(jnp.abs(rows[k] - (1.0 - share) * rows[k - 1] - share * rows[k + 1]))
    most = jnp.max(jnp.stack(bends), axis=0)
    return jnp.broadcast_to(most, (len(rows) - 1, *most.shape))
