"""Detection of changes of time-dependent data that lie between two samples of a step.

Linear enclosures in t of the form 4θ(1−θ) dev (`below_parabola`) bound two kinds of changes:

*Excursions.* A switch function s of K (`AbstractSet.switches`) may have the same sign at two
neighbouring samples and another sign between them, for example during a pulse in h. By the discriminant
of the parabola, s keeps its sign if

    4 dev ≤ (√|s₀| + √|s₁|)².

If the signs at the samples differ, s changes sign once only if 4 dev ≤ |s₁ − s₀|, by the slope of the
parabola at its ends.

*Pulses.* A function q of time (f and h at the state of the step, the parameters of K) may change and
return between two samples. The step is short enough if

    dev ≤ V/4,    V = the largest variation between neighbouring samples so far, halved every 64th of
                  the run.

A wave that the steps resolve satisfies this by a wide margin, because V is its amplitude. A pulse
between two samples does not. Jumps do not count in V, and the halving forgets the start of the run.

Both tests ignore a share of the tolerance. They do not cover changes due to x, which is smooth.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..programs.enclosure import (
    LinearEnclosure,
    below_parabola,
    enclose,
    has_enclosure,
    is_enclosure,
)
from ..vi import independent
from .evaluations import Evaluation
from .flow import Flow, slope

_TRUSTED_SHARE, _TRUSTED_ROUNDINGS = 1e-6, 256.0
"""Length of the steps, as a share of the run, up to which samples are trusted without enclosures, and
its smallest value in roundings of the length of the run: in shorter steps rounding is all that data
do."""

_IGNORED_SHARE = 0.1
"""Depth of an excursion that is ignored, as a share of the tolerance."""

_SAMPLING_SAFETY = 4.0
"""Safety factor of a deviation that is estimated from samples, where there is no enclosure."""

_VARIATION_SHARE = 0.25
"""Allowed deviation between two samples, as a share of the largest variation so far."""

_HALVINGS = 64.0
"""Number of times that a run halves V. At the crest of a wave as long as the run, V is still a tenth of
the variation before it."""


def trusted_length(span: Any) -> Any:
    """Return the length of the steps of a run up to which samples are trusted without enclosures."""
    return max(_TRUSTED_SHARE, _TRUSTED_ROUNDINGS * float(jnp.finfo(span.dtype).eps)) * span


class ExcursionEstimate(NamedTuple):
    """Bounds on the changes between the samples of one step.

    - `excursion(size)`: the largest ratio of a deviation to the deviation that may change a sign, if
      excursions up to `size` are ignored;
    - `law_size`: the largest |y|;
    - `rates`, `laws`: the deviations of the data of f, in the root mean square, and of h and K, minus
      V/4;
    - `variation`: V after the step.
    """

    excursion: Any
    law_size: Any
    rates: Any
    laws: Any
    variation: Tree

    def ratio(self, rtol: Any, atol: Any, rate_tolerance: Any) -> Any:
        """Return the largest deviation relative to the allowed one; above 1 the step is too long."""
        ignored = _IGNORED_SHARE * (atol + rtol * self.law_size)
        worst = jnp.maximum(self.excursion(4.0 * ignored), self.laws / ignored)
        worst = jnp.maximum(worst, self.rates / (_IGNORED_SHARE * rate_tolerance))
        return jnp.where(jnp.isnan(worst), jnp.inf, worst)


class ExcursionGuard(eqx.Module):
    """Bounds on changes between the samples of a step, for data that depends on t other than through
    tables with declared knots.

    - `switches`: bound excursions; K or h depends on t, and K has switch functions;
    - `rates`, `laws`: bound pulses of f, and of h and K; they depend on t and have enclosures;
    - `enclosed`: the switch functions have enclosures; otherwise samples estimate their deviation.
    """

    switches: bool = eqx.field(static=True)
    rates: bool = eqx.field(static=True)
    laws: bool = eqx.field(static=True)
    enclosed: bool = eqx.field(static=True)

    def start(self, flow: Flow, t0: Any, x0: Tree) -> Tree:
        """Return V before the first step, which is zero."""
        data = jax.eval_shape(lambda t: self._data(flow, t, x0, flow.problem.zero_control(x0)), t0)
        return jtu.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), data)

    def estimate(
        self, flow: Flow, evaluations: list[Evaluation], variation: Tree, share: Any
    ) -> ExcursionEstimate:
        """Return bounds on the changes between the samples of a step of this `share` of the run."""
        evaluations, variation = jax.lax.stop_gradient((evaluations, variation))
        samples = [(v.t, v.x, v.rate.y, v.rate.z) for v in evaluations]
        first = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *samples[:-1])
        second = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *samples[1:])
        zero = jnp.zeros_like(evaluations[0].t)
        rates, laws = zero, zero
        if self.rates or self.laws:
            with below_parabola():
                changes, dev = jax.vmap(lambda p, q: self._pulses(flow, p, q))(first, second)
            largest = lambda tree: jtu.tree_map(lambda leaf: jnp.max(leaf, axis=0), tree)  # noqa: E731
            decay = 0.5 ** (_HALVINGS * share)
            # Numbers in a set may have a shorter type than x, or a longer one.
            variation = jtu.tree_map(
                lambda v, m: jnp.maximum(decay * v, m).astype(v.dtype), variation, largest(changes)
            )
            excess = jtu.tree_map(
                lambda d, v: jnp.maximum(d - _VARIATION_SHARE * v, 0.0), largest(dev), variation
            )
            # A pulse in one entry of f changes x as its share of the mean does.
            means = [jnp.sqrt(jnp.mean(leaf**2)) for leaf in excess[0]]
            rates, laws = (
                _largest(part).astype(zero.dtype) if part else zero for part in (means, excess[1])
            )

        def excursion(ignored: Any) -> Any:
            if not self.switches:
                return zero
            rows = [flow.switches_of(v.t, v.x, v.rate) for v in evaluations]
            ratio = self._excursion(flow, samples, rows, first, second, ignored)
            return ratio.astype(zero.dtype)

        # Use y and not z: an entry of z far outside K corresponds to a y at the bound.
        size = _largest([jnp.abs(leaf) for p in samples for leaf in jtu.tree_leaves(p[2])])
        return ExcursionEstimate(excursion, size, rates, laws, variation)

    def _data(self, flow: Flow, t: Any, x: Tree, u: Tree) -> tuple[list[Any], list[Any]]:
        """Return the data of f, and the data of h and K, at t for fixed x and u."""
        problem, args = flow.problem, flow.args
        rates = jtu.tree_leaves(problem.f(t, x, u, args)) if self.rates else []
        if not self.laws:
            return rates, []
        parameters = eqx.filter(problem.set_at(t, args), eqx.is_inexact_array)
        return rates, jtu.tree_leaves((problem.h(t, x, u, args), parameters))

    def _pulses(self, flow: Flow, p: tuple, q: tuple) -> tuple[Tree, Tree]:
        """Return the change of the data from one sample to the next, and a bound on its deviation from
        the line between them."""
        t = LinearEnclosure(p[0], q[0], jnp.zeros_like(p[0]))
        # Use the midpoint: a factor that is zero at a sample would hide the data that it multiplies.
        x, y = jtu.tree_map(lambda a, b: 0.5 * (a + b), (p[1], p[2]), (q[1], q[2]))
        u = flow.operator.inverse(y)
        data = enclose(lambda t: self._data(flow, t, x, u), t)
        # Infinite bounds do not change, and jumps do not count as variation.
        changes = jtu.tree_map(
            lambda c: jnp.where((c.a == c.b) | jnp.isinf(c.dev), 0.0, jnp.abs(c.b - c.a)), data,
            is_leaf=is_enclosure,
        )  # fmt: skip
        dev = jtu.tree_map(
            lambda c: jnp.where((c.a == c.b) & jnp.isinf(c.a), 0.0, c.dev),
            data,
            is_leaf=is_enclosure,
        )
        return changes, dev

    def _excursion(
        self, flow: Flow, samples: Any, rows: Any, first: Any, second: Any, ignored: Any
    ) -> Any:
        """Return the largest ratio of a deviation to the deviation that may change a sign."""
        if self.enclosed:
            with below_parabola():
                devs = jax.vmap(lambda p, q: self._deviation(flow, p, q))(first, second)
        else:
            times = [place[0] for place in samples]
            devs = [
                _SAMPLING_SAFETY * _sampled_deviation(times, list(values))
                for values in zip(*rows, strict=True)
            ]
        ratios = []
        for dev, values in zip(devs, zip(*rows, strict=True), strict=True):
            s0, s1 = jnp.stack(values[:-1]), jnp.stack(values[1:])
            changes = (s0 > 0) != (s1 > 0)
            room = (jnp.sqrt(jnp.abs(s0)) + jnp.sqrt(jnp.abs(s1))) ** 2
            room = jnp.where(changes, jnp.abs(s1 - s0), room)
            ratio = jnp.where(dev <= 0.0, 0.0, 4.0 * dev / (room + ignored))
            # With infinite distance from the switch no deviation changes the sign.
            ratios.append(jnp.where(jnp.isinf(room), 0.0, ratio))
        return _largest(ratios)

    def _deviation(self, flow: Flow, p: tuple, q: tuple) -> list[Any]:
        """Return bounds on the deviations of the switch functions from lines between two samples."""
        t = LinearEnclosure(p[0], q[0], jnp.zeros_like(p[0]))
        bend = _deviation_of_z(flow, t, p[1])
        z = jtu.tree_map(LinearEnclosure, p[3], q[3], bend)
        found = enclose(lambda t, z: flow.switch_parts(t, p[1], z), t, z)
        return [one.dev for one in found]


def guard(flow: Flow, t0: Any, x0: Tree) -> ExcursionGuard | None:
    """Return the guard of a flow, or None if no data depends on t except through declared tables."""
    problem, args = flow.problem, flow.args
    z = problem.zero_control(x0)
    switches = flow.switches(t0, x0, z)
    trial = ExcursionGuard(switches is not None and switches.size > 0, True, True, True)
    rates = not independent(lambda t: problem.f(t, x0, z, args), t0)
    laws = not independent(lambda t: trial._data(flow, t, x0, z)[1], t0)
    trial = dataclasses.replace(trial, switches=trial.switches and laws, rates=rates, laws=laws)

    place = lambda t, x, z: (t, x, z, z)  # noqa: E731
    for name in ("rates", "laws"):
        alone = ExcursionGuard(False, name == "rates", name == "laws", True)
        pulses = lambda *p, alone=alone: alone._pulses(flow, place(*p), place(*p))  # noqa: E731
        if getattr(trial, name) and not has_enclosure(pulses, t0, x0, z):
            trial = dataclasses.replace(trial, **{name: False})
    deviation = lambda *p: trial._deviation(flow, place(*p), place(*p))  # noqa: E731
    if trial.switches and not has_enclosure(deviation, t0, x0, z):
        trial = dataclasses.replace(trial, enclosed=False)
    return trial if trial.switches or trial.rates or trial.laws else None


def _deviation_of_z(flow: Flow, t: LinearEnclosure, x: Tree) -> Tree:
    """Return a bound on the deviation of z from a line that the time dependence of h causes."""
    problem, args = flow.problem, flow.args
    zero = problem.zero_control(x)
    h = enclose(lambda t: problem.h(t, x, zero, args), t)
    dev = jtu.tree_map(lambda line: line.dev, h, is_leaf=is_enclosure)
    if flow.reciprocal is not None:
        return jtu.tree_map(lambda d, r: jnp.abs(d * r), dev, flow.reciprocal)
    if flow.direct and flow.small_box is None:
        a = slope(problem, flow.operator, t.a, x, args)
        return jtu.tree_map(lambda d, s: jnp.abs(d / s), dev, a)
    return jtu.tree_map(jnp.abs, flow.operator.apply(dev))


def _largest(tree: Any) -> Any:
    return jnp.max(jnp.stack([jnp.max(leaf, initial=0.0) for leaf in jtu.tree_leaves(tree)]))


def _sampled_deviation(times: list[Any], rows: list[jax.Array]) -> jax.Array:
    """Return for each interval between samples the largest distance of an inner sample from the line
    through its two neighbours."""
    distances = []
    for k in range(1, len(rows) - 1):
        share = (times[k] - times[k - 1]) / (times[k + 1] - times[k - 1])
        distances.append(jnp.abs(rows[k] - (1.0 - share) * rows[k - 1] - share * rows[k + 1]))
    largest = jnp.max(jnp.stack(distances), axis=0)
    return jnp.broadcast_to(largest, (len(rows) - 1, *largest.shape))
