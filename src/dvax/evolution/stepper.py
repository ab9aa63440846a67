"""One step of an exponential method, and what it is known to miss."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._knots import END_ULPS, KNOT_ULPS
from .._tree import Tree
from ..generators import AbstractPropagator, Arc, Growth
from ..generators.expanded import coefficients, values
from .defect import Sample, enclosed, sampled
from .evaluations import Plan, Visit, evaluated
from .excursions import ExcursionGuard
from .extent import Extent
from .flow import Flow, Rate
from .locate_event import locate_event
from .method import AbstractMethod, shortened
from .moving import if_moving

_SMALL = 64
"""Up to this many entries a look at every one of them is free."""


class Memory(NamedTuple):
    """What an accepted step leaves to the next: the rate at its end, a guess for the law, the
    coefficients of its end in the eigenfunctions of A, and the largest `variation` of the data between
    samples so far (`ExcursionGuard`), each None where it is not needed."""

    rate: Rate | None
    guess: Tree | None
    coefficients: Tree
    variation: Tree


class Factors(NamedTuple):
    """The propagators of a step of this length, of half of it where the method's stages are there, and
    up to the points inside where the defect is sampled."""

    length: jax.Array
    full: AbstractPropagator
    half: AbstractPropagator | None
    inner: tuple[AbstractPropagator, ...]


class Step(NamedTuple):
    """A step to x₁ with its stage polynomial c.

    - `error`: the defect entry by entry, None where it is not measured;
    - `impulse` = (∫ ‖p − f̃(·, x_h)‖ ds, ∫ ‖w‖ ds) over the step;
    - `event(wanted)`: the time of the first kink of the response inside, ∞ where there is none or the
      time is not `wanted`; None where events are not located;
    - `excursion(rtol, atol, rate)`: exceeds 1 where data that moves in time may hide something between
      the samples, given the tolerances of y and of f; None where nothing moves by itself;
    - `extent`: the bounds of x_h and u_h over the step, None where they are not tracked;
    - `begun`, `solved`: the law was solved at the start, and everywhere;
    - `finite`: there is no non-finite value that a smaller step would leave;
    - `evaluations`: of F.
    """

    x1: Tree
    c: tuple[Tree, ...]
    error: Tree | None
    impulse: tuple[Any, Any]
    event: Callable[[Any], Any] | None
    excursion: Callable[[Any, Any, Any], Any] | None
    extent: Extent | None
    memory: Memory
    begun: Any
    solved: Any
    finite: Any
    evaluations: Any


def inside(flow: Flow, length: Any, theta: Any, x0: Tree, c: tuple[Tree, ...]) -> Tree:
    """x_h(t₀ + θh)."""
    return flow.propagator(theta * length, len(c)).step(x0, shortened(c, theta))


def local(
    method: Any,
    flow: Flow,
    t0: Any,
    t1: Any,
    x0: Tree,
    guess: Tree | None,
    ends: tuple[Any, Any],
) -> tuple[Flow, Tree | None]:
    """The flow of the step from t₀ to t₁ and its drift: where the method linearises, others than that
    of the run. `guess` is for the law at x₀."""
    if not method.linearises:
        return flow, None
    flow, drift = flow.linearised(within(t0, t1, 0.0, ends), x0, guess)
    return flow, _tree.scale(t1 - t0, drift)


def within(t0: Any, t1: Any, theta: float, ends: tuple[Any, Any]) -> Any:
    """t₀ + θh, with the ends approached from inside: data may jump there.

    A few roundings inside, since two records may round the same moment differently; at the `ends` of
    the run as many as `Problem.knots` leaves out.
    """
    if 0.0 < theta < 1.0:
        return t0 + theta * (t1 - t0)
    begin, end = ends
    at_end = (t0 == begin) if theta == 0.0 else (t1 == end)
    ulps = jnp.where(at_end, END_ULPS, KNOT_ULPS)
    inset = lax.stop_gradient(jnp.minimum(ulps * _ulp(t0, t1), 0.25 * (t1 - t0)))
    return t0 + inset if theta == 0.0 else t1 - inset


class Stepper(eqx.Module):
    """A method bound to a flow.

    - `measure`: sample the defect inside every step, which adaptive steps and certificates need;
    - `locate`: look for kinks of the response inside every step;
    - `guard`: bounds the excursions between the samples of a step, None where there can be none;
    - `ranged`: keep where x_h and u_h have been, which constants of a region need;
    - `careful`: look for bad values after every step, at the price of a second pass over memory;
    - `ends`: first and last time of the run;
    - `uniform`: the propagators, where all steps have one length that is known beforehand;
    - `growth`: of the semigroup, where the defect is enclosed.
    """

    method: AbstractMethod
    flow: Flow
    measure: bool = eqx.field(static=True)
    locate: bool = eqx.field(static=True)
    guard: ExcursionGuard | None
    ranged: bool = eqx.field(static=True)
    careful: bool = eqx.field(static=True)
    ends: tuple[Any, Any]
    uniform: Factors | None
    growth: Growth | None

    def begin(self, x0: Tree) -> Memory:
        """Before the first step nothing is known but where to look first."""
        guess = self.flow.guess(x0)
        # A method that linearises has another A in every step.
        known = coefficients(x0 if self.method.linearises else self.flow.expand(x0))
        if not self.measure:
            return Memory(None, guess, known, None)
        blank = jax.eval_shape(lambda: self._kept(self.flow.rate(self.ends[0], x0, guess)))
        rate = jtu.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), blank)
        none = None if self.guard is None else self.guard.start(self.flow, self.ends[0], x0)
        return Memory(rate, guess, known, none)

    def extent(self, x0: Tree) -> Extent | None:
        """Before the first step x_h has been at x₀ alone, and u_h nowhere."""
        if not self.ranged:
            return None
        return Extent.at_start(x0, self.flow.problem.zero_control(x0))

    def factors(self, h: Any) -> Factors:
        """Propagators over h."""
        sampled = self.measure and not self.flow.enclosed
        halves = (0.5,) if self.method.halves else ()
        # Each length once: a sample may lie where a stage is.
        thetas = (1.0, *halves, *(self.method.samples if sampled else ()))
        found = self.flow.propagators(tuple(t * h for t in thetas), self.method.degree + 1)
        return Factors(h, found[0], found[1] if halves else None, found[1 + len(halves) :])

    def fitted(self, factors: Factors, t0: Any, t1: Any, anew: Any) -> Factors:
        """Propagators for this step; those of the last one where the length is the same.

        t₀ + h is rounded, so equal steps differ by an ulp of t: that is not a new length. Equal
        lengths may move apart, where `anew` says so: then, if they are differentiated, it is one.
        """

        def fit(h: Any, stepper: Stepper, factors: Factors, slack: Any, new: Any) -> Factors:
            same = _alike(h, factors.length, slack) & jnp.logical_not(new)
            return lax.cond(same, lambda: factors, lambda: stepper.factors(h))

        still = lambda h, s, f, slack, _: fit(h, s, f, slack, False)  # noqa: E731
        return if_moving(fit, still, t1 - t0, self, factors, 2 * _ulp(t0, t1), anew)

    def fits(self, factors: Factors, t0: Any, t1: Any) -> Any:
        """Whether these are the propagators for this step."""
        return _alike(t1 - t0, factors.length, 2 * _ulp(t0, t1))

    def advance(
        self, t0: Any, t1: Any, x0: Tree, factors: Factors | None, guess: Tree | None
    ) -> tuple[Tree, tuple[Tree, ...], Tree | None]:
        """(x₁, the stage polynomial, y where the step begins), and nothing else."""
        self, drift, factors = self._local(t0, t1, x0, factors, guess)
        plan = self._plan(t0, t1, self.flow.expand(x0), factors, drift, False)
        found, visits = evaluated(self.flow, plan, self.ends[0], x0, guess, None, True)
        c, x1 = values(found)
        return x1, c, visits[0].rate.y

    def step(
        self, t0: Any, t1: Any, x0: Tree, memory: Memory, factors: Factors | None, jumped: Any
    ) -> Step:
        """One step from t0 to t1. `jumped` says that what memory holds is not the rate at t0."""
        self, drift, factors = self._local(t0, t1, x0, factors, memory.guess)
        start = self.flow.expand(x0, memory.coefficients)
        plan = self._plan(t0, t1, start, factors, drift, self.measure)
        # The last evaluation of the previous step was made where this one begins.
        begin, kept = self.ends[0], memory.rate
        (c, x1), visits = evaluated(self.flow, plan, begin, x0, memory.guess, kept, jumped)
        arc, known = Arc(t1 - t0, start, x1, c), coefficients(x1)
        c, x1 = values((c, x1))
        first, last = visits[0].rate, visits[-1].rate
        error, impulse, event, excursion, extent = None, (0.0, 0.0), None, None, None
        variation = memory.variation
        if self.measure:
            sample = self._measure(t0, t1, arc, visits, jumped)
            error, impulse = sample.error, (sample.defect, sample.law_defect)
            extent = sample.extent if self.ranged else None
            if self.locate:
                event = partial(self._event, t0, t1, x0, c, first, sample)
            if self.guard is not None:
                along = [visits[0], *visits[-1 - len(sample.thetas) :]]
                share = (t1 - t0) / (self.ends[1] - self.ends[0])
                seen = self.guard.look(self.flow, along, variation, share)
                excursion, variation = seen.ratio, seen.variation
            # Further in, a bad value may come from a step that was too long: it is cut, not fatal.
            finite = _tree.all_finite(first.value)
        else:
            # A look at a large state costs half a step, and a bad entry stays bad (x₁ contains
            # e^{hA}x₀), so `solve` looks at the end and, where it must, runs again carefully.
            look = self.careful or _size(x1) <= _SMALL
            finite = _tree.all_finite(x1) if look else jnp.asarray(True)
        after = Memory(
            self._kept(last) if self.measure else None,
            None if self.flow.direct else last.y,
            known,
            variation,
        )
        solved = jnp.all(jnp.stack([visit.rate.solved for visit in visits]))
        # The first one was made by the step before, unless nothing is kept, or data jumped.
        counts = [visit.rate.evaluations for visit in visits]
        own = counts[0] if kept is None else jnp.where(jumped, counts[0], 0)
        return Step(
            x1, c, error, impulse, event, excursion, extent, after, first.solved, solved, finite,
            sum(counts[1:], own),
        )  # fmt: skip

    def _local(
        self, t0: Any, t1: Any, x0: Tree, factors: Factors | None, guess: Tree | None
    ) -> tuple["Stepper", Tree | None, Factors]:
        """The stepper with the flow of this step, the drift, and the propagators: those given, unless
        the method linearises."""
        if not self.method.linearises:
            assert factors is not None
            return self, None, factors
        flow, drift = local(self.method, self.flow, t0, t1, x0, guess, self.ends)
        stepper = dataclasses.replace(self, flow=flow)
        return stepper, drift, stepper.factors(t1 - t0)

    def _plan(
        self, t0: Any, t1: Any, start: Tree, factors: Factors, drift: Tree | None, measured: bool
    ) -> Plan:
        """The evaluations of a step: at its start, for its stages, inside, and at its end. States are
        expanded (`AbstractGenerator.expand`), and so are c and x₁."""

        def run(evaluate: Callable[[Any, Tree], Rate]) -> tuple[tuple[Tree, ...], Tree]:
            def stage(theta: float, x: Tree) -> Tree:
                x = values(x)
                rate = evaluate(self._within(t0, t1, theta), x)
                return self.flow.expand(self.flow.rest(x, rate.value))

            def propagate(theta: float, c: tuple[Tree, ...]) -> Tree:
                if theta == 1.0:
                    return factors.full.step(start, c)
                assert factors.half is not None and theta == 0.5
                return factors.half.step(start, shortened(c, theta))

            c = self.method.coefficients(stage, propagate, stage(0.0, start), drift)
            x1 = factors.full.step(start, c)
            if measured:
                # No inner ones where the defect is enclosed.
                for theta, to in zip(self.method.samples, factors.inner, strict=False):
                    x = to.step(start, shortened(c, theta))
                    evaluate(self._within(t0, t1, theta), values(x))
                evaluate(self._within(t0, t1, 1.0), values(x1))
            return c, x1

        return run

    def _event(
        self, t0: Any, t1: Any, x0: Tree, c: Any, first: Rate, sample: Sample, wanted: Any
    ) -> Any:
        """Return the time of the first kink of the response along x_h."""
        t0, t1, x0, c, rates = lax.stop_gradient((t0, t1, x0, c, [first, *sample.rates]))
        flow, thetas = self.flow, (0.0, *sample.thetas, 1.0)

        def switches(t: Any, rate: Rate) -> jax.Array:
            found = flow.switches(t, x0, rate.z)
            assert found is not None
            return lax.stop_gradient(found)

        def at(theta: Any) -> jax.Array:
            t = t0 + theta * (t1 - t0)
            x = inside(flow, t1 - t0, theta, x0, c)
            return switches(t, flow.rate(t, x, first.y))

        values = [
            switches(self._within(t0, t1, theta), rate)
            for theta, rate in zip(thetas, rates, strict=True)
        ]
        return t0 + locate_event(thetas, values, at, wanted) * (t1 - t0)

    def _within(self, t0: Any, t1: Any, theta: float) -> Any:
        return within(t0, t1, theta, self.ends)

    def look(
        self, t0: Any, t1: Any, x0: Tree, x1: Tree, c: tuple[Tree, ...], guess: Tree | None
    ) -> tuple[Sample, Any]:
        """The defect of a step that was made elsewhere, and whether the law was solved where it was
        looked at."""

        def run(evaluate: Callable[[Any, Tree], Rate]) -> tuple[tuple[Tree, ...], Tree]:
            for theta, x in zip((0.0, *self.method.samples, 1.0), points, strict=True):
                evaluate(self._within(t0, t1, theta), x)
            return c, x1

        between = [inside(self.flow, t1 - t0, theta, x0, c) for theta in self.method.samples]
        points = [x0, *between, x1]
        _, visits = evaluated(self.flow, run, self.ends[0], x0, guess, None, True)
        sample = self._measure(t0, t1, Arc(t1 - t0, x0, x1, c), visits, True)
        solved = jnp.all(jnp.stack([visit.rate.solved for visit in visits]))
        return sample._replace(rates=[]), solved

    def _kept(self, rate: Rate) -> Rate:
        """What the next step needs of a rate: not the law behind it, where nothing samples it."""
        if not self.flow.enclosed:
            return rate
        return rate._replace(y=None, z=rate.z if self.locate else None)

    def _measure(self, t0: Any, t1: Any, arc: Arc, visits: list[Visit], jumped: Any) -> Sample:
        if not self.flow.enclosed:
            x0, c = values((arc.x0, arc.c))
            return sampled(self.flow, self.method, arc.h, x0, c, visits)
        assert self.growth is not None
        # A rate that the step before made was made where that one ended: a few roundings of t earlier,
        # which a steep f tells apart.
        begin = self._within(t0, t1, 0.0)
        begin = jnp.where(jumped, begin, 2.0 * t0 - begin)
        ends = begin, self._within(t0, t1, 1.0)
        span = self.ends[1] - self.ends[0]
        return enclosed(self.flow, self.growth, ends, arc, visits[-1].rate, span)


def _alike(h: Any, length: Any, slack: Any) -> Any:
    return jnp.abs(h - length) <= slack


def _ulp(t0: Any, t1: Any) -> Any:
    return jnp.finfo(t0.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))


def _size(x: Tree) -> int:
    return sum(leaf.size for leaf in jtu.tree_leaves(x))
