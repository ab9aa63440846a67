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
from ..generators import AbstractPropagator, FlowStep, Growth
from ..generators.spectral_state import coefficients, values
from . import error_estimate, forcing, power_iteration
from .bounds import Bounds
from .defect import Sample, enclosed, roundoff, sampled
from .evaluations import Evaluation, Stages, evaluated
from .excursions import ExcursionGuard
from .flow import Flow, Rate, joined
from .locate_event import locate_event
from .method import AbstractMethod, shortened
from .outcome import Record

_SMALL = 64
"""Up to this many entries a look at every one of them is free."""


_SLOW = 0.1
"""Rate of change of x, as a share of the slope of f̃, below which a slope is called stiff."""


_INSIDE = 0.3, 0.7
"""Where a step is looked at inside if its method samples no defect there."""

_FADED = 1e-3
"""Share of the largest forcing so far below which its changes count less."""


class SolverState(NamedTuple):
    """What the next step reuses of an accepted one: the rate at its end, a guess for the law, the
    coefficients of its end in the eigenfunctions of A, the largest `variation` of the data between
    samples so far (`ExcursionGuard`), an estimate of the `error` of x, and the `direction` of the power
    iteration, the direction of what has `not_decayed`, the largest `slope` at x and the largest
    `forcing` by parameters so far, each None where it is not needed."""

    rate: Rate | None
    guess: Tree | None
    coefficients: Tree
    variation: Tree
    error: Tree | None = None
    direction: Tree | None = None
    not_decayed: Tree | None = None
    slope: Any = None
    forcing: Any = None


class Propagators(NamedTuple):
    """The propagators of a step of this length, of half of it where the method's stages are there, and
    up to the points inside where the defect is sampled."""

    length: jax.Array
    full: AbstractPropagator
    half: AbstractPropagator | None
    inner: tuple[AbstractPropagator, ...]


class Fastest(NamedTuple):
    """The fastest change that a derivative of the run may have within a step.

    - `slope`: h times the largest slope of what the method treats explicitly (`power_iteration`);
    - `variation`: hω, where the derivative of f̃ changes in time as e^{iωt} does;
    - `forcing`: the same of the derivative in parameters (`forcing.groups`);
    - `remaining`: h times the slope of what has not decayed;
    - `kink`: the same as `slope`, with what lies behind a kink of the response;
    - `is_damped`: such a change decays; `ends`: what has not decayed so far decays too;
    - `is_stiff`: x itself changes slowly beside it.
    """

    slope: Any
    variation: Any
    forcing: Any
    remaining: Any
    kink: Any
    is_damped: Any
    ends: Any
    is_stiff: Any


class Step(NamedTuple):
    """A step to x₁ with its stage polynomial c.

    - `error`: the modulus of the defect entry by entry, None where it is not measured; `signed`: its
      signed mean, None where it does not cancel;
    - `integrated_defect` = (∫ ‖p − f̃(·, x_h)‖ ds, ∫ ‖w‖ ds) over the step;
    - `event(wanted)`: the time of the first kink of the response inside, ∞ where there is none or the
      time is not `wanted`; None where events are not located;
    - `excursion(rtol, atol, rate)`: exceeds 1 where data that moves in time may hide something between
      the samples, given the tolerances of y and of f; None where nothing moves by itself;
    - `bounds`: the bounds of x_h and u_h over the step, None where they are not tracked;
    - `start_solved`, `solved`: the law was solved at the start, and everywhere;
    - `finite`: there is no non-finite value that a smaller step would leave;
    - `evaluations`: of F;
    - `stiffness`: h times the slope of f̃ between two stages, None where the method has no such pair;
    - `carried`: the estimated error of x₀, and what the step leaves of it, None where not estimated;
    - `fastest`: what limits the steps of a derivative, None where none is wanted;
    - `unenclosed`: all values are finite, and the defect has no enclosure, as at a jump in time.
    """

    x1: Tree
    c: tuple[Tree, ...]
    error: Tree | None
    integrated_defect: tuple[Any, Any]
    event: Callable[[Any], Any] | None
    excursion: Callable[[Any, Any, Any], Any] | None
    bounds: Bounds | None
    solver_state: SolverState
    start_solved: Any
    solved: Any
    finite: Any
    evaluations: Any
    stiffness: Any = None
    signed: Tree | None = None
    carried: tuple[Tree, Tree] | None = None
    fastest: Fastest | None = None
    unenclosed: Any = False


def interpolate(flow: Flow, length: Any, theta: Any, x0: Tree, c: tuple[Tree, ...]) -> Tree:
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
    if not method.is_rosenbrock:
        return flow, None
    flow, drift = flow.linearised(one_sided_time(t0, t1, 0.0, ends), x0, guess)
    return flow, _tree.scale(t1 - t0, drift)


def dense_output(
    method: Any, flow: Flow, step: Record, guess: Tree | None, ends: tuple[Any, Any], end: Any = None,
) -> Callable[[Any], Tree]:  # fmt: skip
    """Return x_h over a step as a function of θ. `guess` is for the law at its start, `ends` are those
    of the run; `end` is that of the step, by default start + length."""
    end = step.start + step.length if end is None else end
    own, _ = local(method, flow, step.start, end, step.x0, guess, ends)
    return lambda theta: interpolate(own, step.length, theta, step.x0, step.coefficients)


def one_sided_time(t0: Any, t1: Any, theta: float, ends: tuple[Any, Any]) -> Any:
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
    - `track_bounds`: keep where x_h and u_h have been, which constants of a region need;
    - `check_finite`: look for bad values after every step, at the price of a second pass over memory;
    - `estimate`: carry an estimate of the error of x along;
    - `ends`: first and last time of the run;
    - `uniform`: the propagators, where all steps have one length that is known beforehand;
    - `growth`: of the semigroup, where the defect is enclosed;
    - `for_derivatives`: find the largest slope of f̃, which limits steps whose derivative is wanted;
    - `varies`: f̃ depends on t other than through x, so that slopes are looked at inside a step too;
    - `forced_by`: the parameters in which a derivative is wanted, and whose effect on f̃ depends on t.
    """

    method: AbstractMethod
    flow: Flow
    measure: bool = eqx.field(static=True)
    locate: bool = eqx.field(static=True)
    guard: ExcursionGuard | None
    track_bounds: bool = eqx.field(static=True)
    check_finite: bool = eqx.field(static=True)
    estimate: bool = eqx.field(static=True)
    ends: tuple[Any, Any]
    uniform: Propagators | None
    growth: Growth | None
    for_derivatives: bool = eqx.field(static=True, default=False)
    varies: bool = eqx.field(static=True, default=False)
    forced_by: forcing.Groups = eqx.field(static=True, default=())

    def begin(self, x0: Tree) -> SolverState:
        """Before the first step nothing is known but where to look first."""
        guess = self.flow.guess(x0)
        # A method that linearises has another A in every step.
        known = coefficients(x0 if self.method.is_rosenbrock else self.flow.expand(x0))
        if not self.measure:
            return SolverState(None, guess, known, None)
        blank = jax.eval_shape(lambda: self._kept(self.flow.rate(self.ends[0], x0, guess)))
        rate = jtu.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), blank)
        none = None if self.guard is None else self.guard.start(self.flow, self.ends[0], x0)
        error = _tree.zeros_like(x0) if self.estimate else None
        direction, others, slope, forced = None, None, None, None
        if self.for_derivatives:
            space = self.flow.state_space(x0)
            direction = others = power_iteration.pattern(space, x0)
            slope = jnp.zeros_like(self.ends[0])
            forced = jnp.zeros(len(self.forced_by), _tree.dtype(x0))
        return SolverState(rate, guess, known, none, error, direction, others, slope, forced)

    def restart(self, solver_state: SolverState, x: Tree) -> SolverState:
        """Return the state of the stepper after the state of the run was set to x."""
        known = coefficients(x if self.method.is_rosenbrock else self.flow.expand(x))
        return solver_state._replace(coefficients=known)

    def bounds(self, x0: Tree) -> Bounds | None:
        """Before the first step x_h has been at x₀ alone, and u_h nowhere."""
        if not self.track_bounds:
            return None
        return Bounds.at_start(x0, self.flow.problem.zero_control(x0))

    def propagators(self, h: Any) -> Propagators:
        """Propagators over h."""
        sampled = self.measure and not self.flow.enclosed
        half = (0.5,) if self.method.has_half_stage else ()
        # Each length once: a sample may lie where a stage is.
        thetas = (1.0, *half, *(self.method.samples if sampled else ()))
        found = self.flow.propagators(tuple(t * h for t in thetas), self.method.degree + 1)
        return Propagators(h, found[0], found[1] if half else None, found[1 + len(half) :])

    def reuse_or_build(
        self, propagators: Propagators, t0: Any, t1: Any, rebuild: Any
    ) -> Propagators:
        """Propagators for this step: those given where they match and need no `rebuild`."""
        same = self.match(propagators, t0, t1) & ~rebuild
        return lax.cond(same, lambda: propagators, lambda: self.propagators(t1 - t0))

    def match(self, propagators: Propagators, t0: Any, t1: Any) -> Any:
        """Whether these are the propagators for this step, up to a rounding of its length."""
        length = t1 - t0
        return jnp.abs(length - propagators.length) <= jnp.finfo(length.dtype).eps * length

    def advance(
        self, t0: Any, t1: Any, x0: Tree, propagators: Propagators | None, guess: Tree | None
    ) -> tuple[Tree, tuple[Tree, ...], Tree | None]:
        """(x₁, the stage polynomial, y where the step begins), and nothing else."""
        self, drift, propagators = self._local(t0, t1, x0, propagators, guess)
        plan = self._stages(t0, t1, self.flow.expand(x0), propagators, drift, False, None)
        found, evaluations = evaluated(self.flow, plan, self.ends[0], x0, guess, None, True)
        c, x1 = values(found)
        return x1, c, evaluations[0].rate.y

    def step(
        self,
        t0: Any,
        t1: Any,
        x0: Tree,
        solver_state: SolverState,
        propagators: Propagators | None,
        jumped: Any,
    ) -> Step:
        """Make a step from t0 to t1; `jumped`: the rate in `solver_state` is not that at t0."""
        self, drift, propagators = self._local(t0, t1, x0, propagators, solver_state.guess)
        start = self.flow.expand(x0, solver_state.coefficients)
        probe = None
        if self.estimate and not self.method.is_rosenbrock:
            space = self.flow.state_space(x0)
            probe = partial(error_estimate.probe, space, t1 - t0, x0, solver_state.error)
        plan = self._stages(t0, t1, start, propagators, drift, self.measure, probe)
        # The last evaluation of the previous step was made where this one begins.
        begin, kept = self.ends[0], solver_state.rate
        (c, x1), evaluations = evaluated(
            self.flow, plan, begin, x0, solver_state.guess, kept, jumped
        )
        arc, known = FlowStep(t1 - t0, start, x1, c), coefficients(x1)
        c, x1 = values((c, x1))
        first, last = evaluations[0].rate, evaluations[-1].rate
        error, integrated_defect, event, excursion, bounds = None, (0.0, 0.0), None, None, None
        stiffness, signed, carried, estimate = None, None, None, None
        variation, fastest = solver_state.variation, None
        tangents = solver_state[5:]
        if self.measure:
            slopes = self._slopes(t1 - t0, evaluations)
            whole = None if slopes is None else slopes[1]
            propagate = None
            if self.method.is_rosenbrock:
                zero = _tree.zeros_like(x0)
                propagate = lambda c: propagators.full.step(zero, c)  # noqa: E731
            sample = self._measure(t0, t1, arc, evaluations, jumped, whole, propagate)
            error, integrated_defect = sample.error, (sample.defect, sample.law_defect)
            signed = sample.signed
            if self.estimate:
                slope = None if slopes is None else slopes[self.method.explicit_in_A]
                carried, estimate = self._carried(
                    t1 - t0, x0, solver_state.error, evaluations, propagators, sample, slope
                )
            bounds = sample.bounds if self.track_bounds else None
            if self.locate:
                event = partial(self._event, t0, t1, x0, c, first, sample)
            if self.guard is not None:
                along = [evaluations[0], *evaluations[-1 - len(sample.thetas) :]]
                share = (t1 - t0) / (self.ends[1] - self.ends[0])
                seen = self.guard.estimate(self.flow, along, variation, share)
                excursion, variation = seen.ratio, seen.variation
            # Where x itself changes at a comparable rate, accuracy requires such steps too.
            space = self.flow.state_space(x0)
            distance = space.norm(_tree.sub(x1, x0))
            change = jnp.where(distance > 0.0, distance / space.norm(x1), 0.0)
            if slopes is not None:
                slope = slopes[self.method.explicit_in_A]
                stiffness = jnp.where(change < _SLOW * slope, slope, 0.0)
            if self.for_derivatives:
                others = evaluations[-1 - len(sample.thetas) :]
                fastest, tangents = self._fastest(
                    t1 - t0,
                    evaluations[0],
                    others,
                    sample.thetas,
                    solver_state,
                    propagators,
                    change,
                )
            # Further in, a bad value may come from a step that was too long: it is cut, not fatal.
            finite = _tree.all_finite(first.value)
        else:
            # A look at a large state costs half a step, and a bad entry stays bad (x₁ contains
            # e^{hA}x₀), so `solve` looks at the end and, where it must, runs again carefully.
            look = self.check_finite or _size(x1) <= _SMALL
            finite = _tree.all_finite(x1) if look else jnp.asarray(True)
        after = SolverState(
            self._kept(last) if self.measure else None,
            None if self.flow.direct else last.y,
            known,
            variation,
            estimate,
            *tangents,
        )
        solved = jnp.all(jnp.stack([one.rate.solved for one in evaluations]))
        unenclosed: Any = False
        if self.measure and self.flow.enclosed:
            unenclosed = solved & _tree.all_finite((x1, last.value)) & ~_tree.all_finite(error)
        # The first one was made by the step before, unless nothing is kept, or data jumped.
        counts = [one.rate.evaluations for one in evaluations]
        own = counts[0] if kept is None else jnp.where(jumped, counts[0], 0)
        return Step(
            x1, c, error, integrated_defect, event, excursion, bounds, after, first.solved, solved,
            finite, sum(counts[1:], own), stiffness, signed, carried, fastest, unenclosed,
        )  # fmt: skip

    def _local(
        self, t0: Any, t1: Any, x0: Tree, propagators: Propagators | None, guess: Tree | None
    ) -> tuple["Stepper", Tree | None, Propagators]:
        """The stepper with the flow of this step, the drift, and the propagators: those given, unless
        the method linearises."""
        if not self.method.is_rosenbrock:
            assert propagators is not None
            return self, None, propagators
        flow, drift = local(self.method, self.flow, t0, t1, x0, guess, self.ends)
        stepper = dataclasses.replace(self, flow=flow)
        return stepper, drift, stepper.propagators(t1 - t0)

    def _stages(
        self,
        t0: Any,
        t1: Any,
        start: Tree,
        propagators: Propagators,
        drift: Tree | None,
        measured: bool,
        probe: Callable[[Tree], Tree] | None,
    ) -> Stages:
        """The evaluations of a step: at its start, for its stages, at the state that `probe` makes of
        c₀, inside, and at its end. States are expanded (`AbstractGenerator.expand`), and so are c and
        x₁."""

        def run(evaluate: Callable[[Any, Tree], Rate]) -> tuple[tuple[Tree, ...], Tree]:
            def stage(theta: float, x: Tree) -> Tree:
                x = values(x)
                rate = evaluate(self._one_sided_time(t0, t1, theta), x)
                return self.flow.expand(self.flow.nonlinear_part(x, rate.value))

            def propagate(theta: float, c: tuple[Tree, ...]) -> Tree:
                if theta == 1.0:
                    return propagators.full.step(start, c)
                assert propagators.half is not None and theta == 0.5
                return propagators.half.step(start, shortened(c, theta))

            c = self.method.coefficients(stage, propagate, stage(0.0, start), drift)
            x1 = propagators.full.step(start, c)
            if probe is not None:
                evaluate(self._one_sided_time(t0, t1, 0.0), probe(values(c[0])))
            if measured:
                # No inner ones where the defect is enclosed.
                for theta, to in zip(self.method.samples, propagators.inner, strict=False):
                    x = to.step(start, shortened(c, theta))
                    evaluate(self._one_sided_time(t0, t1, theta), values(x))
                evaluate(self._one_sided_time(t0, t1, 1.0), values(x1))
            return c, x1

        return run

    def _carried(
        self,
        h: Any,
        x0: Tree,
        error: Tree | None,
        evaluations: list[Evaluation],
        propagators: Propagators,
        sample: Sample,
        slope: Any,
    ) -> tuple[tuple[Tree, Tree], Tree]:
        """Return the estimated error of x₀ and what the step leaves of it, and that of x₁."""
        x0, error, evaluations, propagators, sample = lax.stop_gradient(
            (x0, error, evaluations, propagators, sample)
        )
        left = error
        if not self.method.is_rosenbrock:
            space = self.flow.state_space(x0)
            probe, first = evaluations[-2 - len(sample.thetas)], evaluations[0]
            there, here = (
                self.flow.nonlinear_part(x, one.rate.value)
                for x, one in ((probe.x, probe), (x0, first))
            )
            left = error_estimate.with_decay(space, h, x0, error, there, here)
        left = error_estimate.finite_or_zero(
            values(propagators.full.step(self.flow.expand(left), ()))
        )
        after = error_estimate.finite_or_zero(
            jtu.tree_map(
                lambda l, m: l + jnp.where(l < 0, -1, 1) * jnp.abs(h * m), left, sample.mean
            )
        )
        return (error, error_estimate.counted(error, left, sample.kinked, slope)), after

    def _slopes(self, h: Any, evaluations: list[Evaluation]) -> tuple[Any, Any] | None:
        """Return h ‖Δf̃‖/‖Δx‖ and h ‖AΔx + Δf̃‖/‖Δx‖ for the difference of two stages at one time, NaN
        where they agree; None where the method has no such pair."""
        if self.method.pair is None:
            return None
        one, two = (evaluations[k] for k in self.method.pair)
        space, apart = self.flow.state_space(one.x), _tree.sub(one.x, two.x)
        change = _tree.sub(one.rate.value, two.rate.value)
        whole = _tree.add(change, self.flow.generator.apply(apart))
        scale = h / space.norm(apart)
        return lax.stop_gradient((scale * space.norm(change), scale * space.norm(whole)))

    def _fastest(
        self,
        h: Any,
        first: Evaluation,
        others: list[Evaluation],
        nodes: tuple[float, ...],
        solver_state: SolverState,
        propagators: Propagators | None,
        change: Any,
    ) -> tuple[Fastest, tuple[Tree, Tree, Any, Any]]:
        """Return what limits the steps of a derivative, and the next directions of the power iteration
        with the slope at x₁ and the largest forcing. The `others` are evaluations at the `nodes` in the
        step and at its end; `change` is that of x over the step, relative to x."""
        flow, h, first, others, solver_state, propagators, change = _constant(
            (self.flow, h, first, others, solver_state, propagators, change)
        )
        space = flow.state_space(first.x)
        pattern = power_iteration.pattern(space, first.x)
        places, nodes = [first, *others], (0.0, *nodes, 1.0)
        known = all(v.rate.y is not None for v in places)
        looks = [(v.t, v.x, v.rate.y if known else solver_state.guess) for v in places]
        if not self.varies:
            # Where nothing but x moves, the step before has looked at the start.
            looks, places, nodes = looks[-1:], places[-1:], nodes[-1:]
        elif len(looks) == 2:
            between = [_between(theta, *looks) for theta in _INSIDE]
            looks, nodes = [looks[0], *between, looks[1]], (0.0, *_INSIDE, 1.0)
        solved = flow.with_known_response() if known else flow
        p = forcing.parameters(flow, self.forced_by)

        def look(t: Any, x: Tree, y: Tree | None) -> tuple[Any, Any, Tree]:
            def value(x: Tree, p: list[jax.Array]) -> Tree:
                own = forcing.with_parameters(solved, self.forced_by, p)
                return flow.nonlinear_part(x, own.rate(t, x, y).value)

            of_both = power_iteration.linearised(value, x, p)

            def push(v: Tree, weights: jax.Array) -> Tree:
                image = of_both(v, forcing.directions(flow, self.forced_by, weights))
                if not self.method.is_rosenbrock:
                    return image
                assert propagators is not None
                return propagators.full.step(_tree.zeros_like(x), (image,))

            d, e = solver_state.direction, solver_state.not_decayed
            (of_d, of_e), forced = power_iteration.images(push, (d, e), len(self.forced_by))
            found = power_iteration.refine(space, d, *of_d, pattern)
            rest = power_iteration.remaining(space, e, *of_e, found.slope, pattern)
            return found, rest, forced

        found, (slopes, ends, others), forced = lax.map(
            lambda at: look(*at), jtu.tree_map(lambda *leaves: jnp.stack(leaves), *looks)
        )
        steepest = jnp.argmax(found.slope)
        variation, _ = power_iteration.variation(space, nodes, found.first)
        of_forcing, largest = jnp.zeros_like(h), solver_state.forcing
        if self.forced_by:
            rows = jtu.tree_map(lambda leaf: jnp.moveaxis(leaf, 1, 0), forced)
            each, sizes = jax.vmap(
                lambda rows, least: power_iteration.variation(space, nodes, rows, least)
            )(rows, _FADED * largest)
            of_forcing, largest = jnp.max(each), jnp.maximum(largest, sizes)
        if self.method.is_rosenbrock:
            # The jump of Df̃ at a kink does not shrink with the step, and steps end at kinks.
            slope = jnp.max(jnp.where(self._same_side(first, places), found.slope, 0.0))
            kink, no = found.slope[steepest], jnp.asarray(False)
            zero = jnp.zeros_like(slope)
            fastest = Fastest(slope, variation, of_forcing, zero, kink, no, no, no)
        else:
            slope = h * jnp.maximum(found.slope[steepest], solver_state.slope)
            is_damped = found.is_damped[steepest]
            rest = h * jnp.max(slopes)
            is_stiff = change < _SLOW * slope
            is_ending = jnp.all(ends)
            fastest = Fastest(
                slope, variation, of_forcing, rest, slope, is_damped, is_ending, is_stiff
            )
        direction = jtu.tree_map(lambda leaf: leaf[steepest], found.direction)
        last = jtu.tree_map(lambda leaf: leaf[-1], others)
        return _constant((fastest, (direction, last, found.slope[-1], largest)))

    def _same_side(self, first: Evaluation, others: list[Evaluation]) -> jax.Array:
        """Return for the others whether no kink of the response lies between them and the first one;
        true where events are not located."""
        if not self.locate:
            return jnp.ones(len(others), bool)

        def sides(v: Evaluation) -> jax.Array:
            found = self.flow.switches_of(v.t, v.x, v.rate)
            assert found is not None
            return joined(found, _tree.dtype(v.rate.z)) > 0.0

        return jnp.stack([jnp.all(sides(v) == sides(first)) for v in others])

    def _event(
        self, t0: Any, t1: Any, x0: Tree, c: Any, first: Rate, sample: Sample, wanted: Any
    ) -> Any:
        """Return the time of the first kink of the response along x_h."""
        t0, t1, x0, c, rates = lax.stop_gradient((t0, t1, x0, c, [first, *sample.rates]))
        flow, thetas = self.flow, (0.0, *sample.thetas, 1.0)

        def switches(t: Any, rate: Rate) -> jax.Array:
            found = flow.switches_of(t, x0, rate)
            assert found is not None
            return lax.stop_gradient(joined(found, _tree.dtype(rate.z)))

        def at(theta: Any) -> jax.Array:
            t = t0 + theta * (t1 - t0)
            x = interpolate(flow, t1 - t0, theta, x0, c)
            return switches(t, flow.rate(t, x, first.y))

        values = [
            switches(self._one_sided_time(t0, t1, theta), rate)
            for theta, rate in zip(thetas, rates, strict=True)
        ]
        return t0 + locate_event(thetas, values, at, wanted) * (t1 - t0)

    def _one_sided_time(self, t0: Any, t1: Any, theta: float) -> Any:
        return one_sided_time(t0, t1, theta, self.ends)

    def estimate_defect(
        self, t0: Any, t1: Any, x0: Tree, x1: Tree, c: tuple[Tree, ...], guess: Tree | None
    ) -> tuple[Sample, Any]:
        """The defect of a step that was made elsewhere, and whether the law was solved where it was
        looked at."""

        def run(evaluate: Callable[[Any, Tree], Rate]) -> tuple[tuple[Tree, ...], Tree]:
            for theta, x in zip((0.0, *self.method.samples, 1.0), points, strict=True):
                evaluate(self._one_sided_time(t0, t1, theta), x)
            return c, x1

        between = [interpolate(self.flow, t1 - t0, theta, x0, c) for theta in self.method.samples]
        points = [x0, *between, x1]
        _, evaluations = evaluated(self.flow, run, self.ends[0], x0, guess, None, True)
        sample = self._measure(t0, t1, FlowStep(t1 - t0, x0, x1, c), evaluations, True, None, None)
        solved = jnp.all(jnp.stack([one.rate.solved for one in evaluations]))
        return sample._replace(rates=[]), solved

    def _kept(self, rate: Rate) -> Rate:
        """What the next step needs of a rate: not the law behind it, where nothing samples it."""
        if not self.flow.enclosed or self.flow.interpolated:
            return rate
        return rate._replace(y=None, z=rate.z if self.locate else None)

    def _measure(
        self,
        t0: Any,
        t1: Any,
        arc: FlowStep,
        evaluations: list[Evaluation],
        jumped: Any,
        slope: Any,
        propagate: Callable[[tuple[Tree, ...]], Tree] | None,
    ) -> Sample:
        if not self.flow.enclosed:
            x0, c = values((arc.x0, arc.c))
            sample = sampled(self.flow, self.method, arc.h, x0, c, evaluations, slope, propagate)
        else:
            assert self.growth is not None
            # A rate that the step before made was made where that one ended: a few roundings of t
            # earlier, which a steep f distinguishes.
            begin = self._one_sided_time(t0, t1, 0.0)
            begin = jnp.where(jumped, begin, 2.0 * t0 - begin)
            ends = begin, self._one_sided_time(t0, t1, 1.0)
            span = self.ends[1] - self.ends[0]
            rates = evaluations[0].rate, evaluations[-1].rate
            sample = enclosed(self.flow, self.growth, ends, arc, rates, span)
        space = self.flow.state_space(values(arc.x1))
        first, last = (self._one_sided_time(t0, t1, theta) for theta in (0.0, 1.0))
        inset = lax.stop_gradient((first - t0) + (t1 - last))
        rounding = roundoff(space, lax.stop_gradient(self.flow.generator), arc, inset)
        return sample._replace(defect=sample.defect + rounding)


def _between(theta: float, *ends: tuple[Any, Tree, Tree | None]) -> tuple[Any, Tree, Tree | None]:
    """Return (t, x, y) on the line between two."""
    return jtu.tree_map(lambda a, b: (1.0 - theta) * a + theta * b, *ends)


def _constant(tree: Any) -> Any:
    """Return the tree with no derivative in its numbers."""
    numbers, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(lax.stop_gradient(numbers), rest)


def _size(x: Tree) -> int:
    return sum(leaf.size for leaf in jtu.tree_leaves(x))


def _ulp(t0: Any, t1: Any) -> Any:
    return jnp.finfo(t0.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
