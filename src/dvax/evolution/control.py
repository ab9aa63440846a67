"""Where steps end: on the knots of data, and where the defect allows."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace, Product
from .excursions import WATCH
from .kinks import Aim, aim, nothing_ahead, passed, until
from .results import RESULTS
from .roundoff_guard import SMALLEST_NOISE, RoundoffGuard
from .stepper import Step

_TRUST, _CALM = 0.12, 9.0
"""After k steps that were kept one may grow by 1 + 0.12 k²; more than nine say nothing more."""

GROWTH = 5.0
"""Largest growth factor of the step size."""

_CROSSINGS = 4
"""Consecutive steps of the roundoff length that may exceed the tolerance and its reserve."""

_ROUNDINGS = 1e6
"""Roundings of f̃ that a defect may amount to and count as roundoff: a law with a small modulus
amplifies them by 1/γ."""

_MOST_ROUNDOFF = 1e-4
"""Part of f̃ above which no defect counts as roundoff, wherever t is."""

_SHORTER = 0.3
"""Largest factor of the step size after a step that may hide an excursion."""


class Verdict(NamedTuple):
    """On one attempt: whether it is `kept`, the controller's state for the next one, whether data
    `jumped` at its end, and how the run stands."""

    kept: Any
    state: Any
    jumped: Any
    result: RESULTS


class AbstractController(eqx.Module):
    """Chooses where each step ends.

    `stops` = (t₀, knots…, t₁) are the times at which a step must end; `adapts` says that only a run
    shows where the others do.
    """

    stops: eqx.AbstractVar[jax.Array]
    adapts: eqx.AbstractClassVar[bool]

    @abc.abstractmethod
    def init(self) -> Any:
        """The state before the first step."""

    @abc.abstractmethod
    def end(self, state: Any) -> Any:
        """Where the next attempt ends."""

    @abc.abstractmethod
    def judge(self, t0: Any, t1: Any, x0: Tree, step: Step, state: Any) -> Verdict:
        """What becomes of the step that was attempted from t0 to t1."""

    @abc.abstractmethod
    def next_length(self, state: Any) -> Any:
        """The length that a run continued from here should begin with."""

    @abc.abstractmethod
    def boundary(self, index: Any, ends: Any) -> Any:
        """The start of step number `index` as a function of the stops, given the recorded `ends` of
        steps (None where nothing adapts). Elsewhere than on a stop, where a step ends is a
        choice that derivatives do not see."""


class Adaptive(AbstractController):
    """Steps as long as the defect stays below (atol + rtol‖x‖)/horizon.

    ‖·‖ is the root mean square in the state space, taken part by part where the state is a tuple, so
    that parts with different units are each held to their own size. Entry by entry it is not: where
    an entry passes through zero, nothing asks for a better rate there.

    The defect integrated over these steps is then at most the tolerance. A kink or an unannounced jump
    inside a step has a defect that does not shrink with h; its impulse h·defect does, and such steps
    have the tolerance once more among them, each spending at most a small part of what is left. So
    the computed trajectory is the exact one of a system disturbed by no more than twice the tolerance.
    Neither does a defect that is rounding shrink with h: steps double while it stays as it is
    (`RoundoffGuard`), and spend of the same.

    Where the stepper locates kinks of the response, steps are made to end there (`kinks`).

    `order` is that of the defect. A length is kept while it is within a fifth of the best one, since
    a new length costs new φ-functions; and the rest of the way to a knot is cut into equal parts,
    never into a sliver.
    """

    stops: jax.Array
    rtol: Any
    atol: Any
    first: Any
    first_growth: Any
    longest: Any
    horizon: Any
    order: int = eqx.field(static=True)
    sizes: Callable[[Tree], list[Any]]

    adapts: ClassVar[bool] = True

    class State(NamedTuple):
        end: Any
        length: Any
        stop: Any
        calm: Any
        spare: Any
        aim: Any
        guard: RoundoffGuard
        crossings: Any

    def init(self):
        first = lax.stop_gradient(jnp.minimum(self.first, self.longest))
        end = land(self.stops[0], first, self.stops[1])
        one = jnp.ones_like(first)
        guard = RoundoffGuard.at_start(first)
        aim, none = nothing_ahead(first), jnp.asarray(0)
        return self.State(end, first, jnp.asarray(1), _CALM * one, one, aim, guard, none)

    def end(self, state):
        return state.end

    def next_length(self, state):
        return state.length

    def judge(self, t0, t1, x0, step, state):
        h = t1 - t0
        # Where a step ends is a choice, not a function of the data: derivatives see the steps as given.
        error = lax.stop_gradient(self.horizon * self._scaled(step.error, x0, step.x1))
        # A law that is not solved further in may be that of a stage far out: the step was too long.
        error = jnp.where(step.solved, error, jnp.inf)
        impulse = error * h / self.horizon
        # An error of rounding, until it grows with the length.
        rounding = error <= 2.0 ** min(1.0, 0.5 * self.order) * state.guard.noise_floor
        # A small share, because a derivative loses a kink's step; a large one where no step is better.
        floor = 8 * jnp.finfo(h.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
        share = jnp.where((h <= 1e4 * floor) | rounding, 0.1, 1e-6)
        # A step may be taken all the same that is short after a refusal, aimed to cross a kink, or
        # kept for rounding.
        known = Aim(*state.aim)
        excursion = jnp.zeros_like(h)
        if step.excursion is not None:
            watched = h > WATCH * (self.stops[-1] - self.stops[0])
            parts = zip(self.sizes(x0), self.sizes(step.x1), strict=True)
            least = jnp.min(jnp.stack([self.atol + self.rtol * jnp.maximum(*p) for p in parts]))
            ratio = step.excursion(self.rtol, self.atol, least / self.horizon)
            excursion = jnp.where(watched, ratio, 0.0)
            excursion = lax.stop_gradient(excursion)
        # A kink is located only where the step is too long for it.
        kink = jnp.full_like(h, jnp.inf)
        if step.kink is not None:
            kink = lax.stop_gradient(step.kink((error > 1.0) | (excursion > 1.0)))
        # No step size reduces what the roundoff of f, h and K leaves: the reserve does not limit it.
        size = self.horizon * self._scaled(step.c[0], x0, step.x1)
        span = self.stops[-1] - self.stops[0]
        # Data that moves within the run has the rounding of t besides, relative to the run.
        relative = jnp.finfo(h.dtype).eps * (1.0 + jnp.maximum(jnp.abs(t0), jnp.abs(t1)) / span)
        roundoff = rounding & (error <= jnp.minimum(_ROUNDINGS * relative, _MOST_ROUNDOFF) * size)
        roundoff = lax.stop_gradient(roundoff)
        relaxed = (impulse <= share * state.spare) | roundoff
        # The time of a jump is uncertain by the roundoff of t: no shorter step resolves it.
        fine = 4.0 * floor <= WATCH * (self.stops[-1] - self.stops[0])
        at_floor = fine & (h <= 4.0 * floor) & (state.crossings < _CROSSINGS)
        at_floor = at_floor & jnp.isfinite(error)
        sound = step.begun & step.finite
        keep = sound & ((error <= 1.0) | relaxed | at_floor) & (excursion <= 1.0)
        spare = jnp.where(
            keep & (error > 1.0) & ~roundoff,
            jnp.maximum(state.spare - impulse, 0.0),
            state.spare,
        )
        crossed = jnp.where(keep & ~relaxed & (error > 1.0), state.crossings + 1, state.crossings)
        crossings = jnp.where(keep & (error <= 1.0) & (h > 16.0 * floor), 0, crossed)

        positive = jnp.where(error > 0.0, error, 1.0)
        factor = jnp.where(error > 0.0, (0.5 / positive) ** (1.0 / self.order), jnp.inf)
        # What was just refused is not tried again at once, nor soon: in a field, whose kinks a step
        # meets or misses, one good step says little about the next.
        first = (t0 == self.stops[0]) & (state.calm >= _CALM)
        growth = jnp.minimum(1.0 + _TRUST * state.calm**2, GROWTH)
        growth = jnp.where(first, self.first_growth, growth)
        if step.excursion is not None:
            # The width of an enclosure falls with h², and the room beside it often too.
            room = 0.9 * jnp.where(excursion > 0.0, excursion, 1.0) ** -0.5
            room = jnp.where(excursion > 1.0, jnp.minimum(room, _SHORTER), room)
            growth = jnp.where(excursion > 0.0, jnp.minimum(growth, room), growth)
        factor = jnp.clip(factor, 0.1, jnp.maximum(growth, 0.1))
        steady = keep & (factor > 0.8) & (factor < 1.25)
        length = lax.stop_gradient(h)
        guard = state.guard.after(length, error, keep, state.calm, self.order)
        wanted = jnp.where(steady, length, length * factor)
        wanted = jnp.where(
            keep & (guard.noise_floor > 0.0), jnp.maximum(wanted, 2.0 * length), wanted
        )
        # A step cut short by a knot says little about the length that was planned.
        cut = keep & (h < 0.99 * state.length)
        wanted = jnp.where(
            cut, jnp.maximum(wanted, jnp.minimum(state.length, 3.0 * wanted)), wanted
        )

        # A kink explains why a step was refused: the length that was planned stays.
        refused = ~keep & sound & jnp.isfinite(error)
        ahead, aimed = aim(state.aim, kink, length, state.length, floor, refused)
        hindered = aimed | (keep & (known.kink < jnp.inf))
        wanted = jnp.where(hindered, jnp.maximum(wanted, state.length), wanted)
        ahead = lax.stop_gradient(passed(ahead, jnp.where(keep, t1, t0)))

        # Steps that were kept since one was refused for anything but a kink.
        still = jnp.where(aimed, jnp.maximum(state.calm, 1.0), 0.0)
        calm = jnp.where(keep, jnp.minimum(state.calm + 1.0, guard.wait), still)
        jumped = keep & (t1 == self.stops[state.stop])
        last = self.stops.shape[0] - 1
        stop = jnp.minimum(jnp.where(jumped, state.stop + 1, state.stop), last)
        begin = jnp.where(keep, t1, t0)
        # A shorter step would not move t.
        wanted = jnp.minimum(jnp.maximum(wanted, floor), self.longest)
        end = land(begin, wanted, until(ahead, begin, self.stops[stop]))
        # Below this, t itself cannot tell the ends of a step apart; and rounding may spend no more.
        exhausted = (
            rounding & ~roundoff & (state.spare < 1e-3) & (state.guard.last_error > SMALLEST_NOISE)
        )
        # (A length is rounded with the times between which it lies.)
        stuck = ~keep & ((h <= 1.25 * floor) | exhausted)
        result = RESULTS.where(
            stuck,
            RESULTS.where(
                step.solved,
                RESULTS.where(jnp.isfinite(error), RESULTS.step_too_small, RESULTS.nonfinite),
                RESULTS.law_unsolved,
            ),
            RESULTS.successful,
        )
        result = RESULTS.where(step.begun, result, RESULTS.law_unsolved)
        result = RESULTS.where(step.finite, result, RESULTS.nonfinite)
        return Verdict(
            keep,
            self.State(end, wanted, stop, calm, spare, ahead, guard, crossings),
            jumped,
            result,
        )

    def boundary(self, index, ends):
        before = jnp.where(index > 0, ends[jnp.maximum(index - 1, 0)], self.stops[0])
        t = lax.stop_gradient(before)
        nearest = self.stops[jnp.argmin(jnp.abs(self.stops - t))]
        return jnp.where(nearest == t, nearest, t)

    def _scaled(self, error: Tree, before: Tree, after: Tree) -> Any:
        parts = zip(self.sizes(error), self.sizes(before), self.sizes(after), strict=True)
        ratios = [e / (self.atol + self.rtol * jnp.maximum(a, b)) for e, a, b in parts]
        ratio = jnp.max(jnp.stack(ratios)) if len(ratios) > 1 else ratios[0]
        # What is not a number is no reason to accept, nor to lengthen.
        return jnp.where(jnp.isnan(ratio), jnp.inf, ratio)


def land(t: Any, length: Any, until: Any) -> Any:
    """The end of a step from t: `until` itself when in reach, half way when one step nearly is."""
    rest = until - t
    reaches = length >= rest * (1 - 1e-9)
    inner = t + jnp.where(2 * length > rest, 0.5 * rest, length)
    return jnp.where(reaches, until, lax.stop_gradient(inner))


class Fixed(AbstractController):
    """Equal steps no longer than dt between one stop and the next."""

    stops: jax.Array
    dt: Any

    adapts: ClassVar[bool] = False

    class State(NamedTuple):
        segment: Any
        step: Any

    def init(self):
        return self.State(jnp.asarray(0), jnp.asarray(1))

    def end(self, state):
        return self._time(state.segment, state.step)

    def next_length(self, state):
        return self.dt

    def judge(self, t0, t1, x0, step, state):
        if self.stops.shape[0] == 2:
            new, jumped = self.State(state.segment, state.step + 1), jnp.asarray(False)
        else:
            last = self.stops.shape[0] - 2
            jumped = state.step >= self._counts()[state.segment]
            segment = jnp.minimum(state.segment + jnp.where(jumped, 1, 0), last)
            new = self.State(segment, jnp.where(jumped, 1, state.step + 1))
        # Steps that are measured are only known to begin well.
        finite = step.finite if step.error is None else step.finite & _tree.all_finite(step.x1)
        result = RESULTS.where(step.solved, RESULTS.successful, RESULTS.law_unsolved)
        result = RESULTS.where(finite, result, RESULTS.nonfinite)
        return Verdict(step.solved & finite, new, jumped, result)

    def boundary(self, index, ends):
        if self.stops.shape[0] == 2:
            return self._time(0, index)
        counts = self._counts()
        # How many steps end by the end of each segment; of few numbers as a sum of products, which
        # stays within one function (`_one_function`).
        if len(counts) <= 32:
            upto = jnp.sum(np.tri(len(counts), dtype=int) * counts[None], axis=1)
            segment = jnp.sum(upto <= index)
        else:
            upto = jnp.cumsum(counts)
            segment = jnp.searchsorted(upto, index, side="right")
        segment = jnp.minimum(segment, len(counts) - 1)
        before = jnp.where(segment > 0, upto[segment - 1], 0)
        return self._time(segment, index - before)

    def _counts(self) -> Any:
        return step_count(jnp.diff(self.stops), self.dt).astype(int)

    def _time(self, segment: Any, step: Any) -> Any:
        left, right = self.stops[segment], self.stops[segment + 1]
        count, step = step_count(right - left, self.dt), jnp.asarray(step, left.dtype)
        # The last one is the stop itself, not a sum that rounds past it.
        return jnp.where(step >= count, right, left + step * ((right - left) / count))


def step_count(span: Any, dt: Any) -> Any:
    """The fewest equal steps no longer than dt (up to rounding) that fill the span."""
    return jnp.maximum(jnp.ceil(span / dt * (1 - 1e-12)), 1.0)


def root_mean_squares(space: AbstractSpace) -> Callable[[Tree], list[Any]]:
    """The root mean square of each part of a state: its norm divided by that of the constant 1."""
    if isinstance(space, Product):
        spaces = space.spaces
        return lambda tree: [_mean(s, p) for s, p in zip(spaces, tree, strict=True)]
    return lambda tree: [_mean(space, tree)]


def _mean(space: AbstractSpace, part: Tree) -> Any:
    norm = space.norm(part)
    return norm / jnp.sqrt(space.size()).astype(norm.dtype)
