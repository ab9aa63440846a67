"""Adaptive steps."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ..._tree import Tree
from ..excursions import trusted_length
from ..results import RESULTS
from ..stepper import Step
from .controller import AbstractController, StepDecision, clip_to_stop, slack
from .error_budget import ErrorBudget
from .error_test import Attempt, ErrorTest
from .event_bracket import EventBracket
from .growth_limiter import GrowthLimiter, limit_by_excursion, next_size, resume_planned
from .roundoff_guard import RoundoffGuard
from .stiffness_guard import StiffnessGuard
from .tangent_limit import TangentLimit


class Adaptive(AbstractController):
    """Steps whose defect is at most (atol + rtol‖x‖)/horizon in the mean: of its norm, or the signed
    mean where it cancels over a smooth step; or more, where earlier errors decay (`ErrorTest`).

    Without such a decay the defect integrated over these steps is at most the tolerance. Steps over
    kinks and jumps may amount to the tolerance once more (`ErrorBudget`), so that the computed
    trajectory is the exact one of a system with a disturbance of at most twice the tolerance.

    `decide` composes the parts in this order; each is a file of this folder:

    1. `ErrorTest` measures the step, and `ErrorBudget` says which steps above the tolerance are
       accepted;
    2. the `GrowthLimiter` chooses the next step size, below the `TangentLimit` where a derivative is
       wanted;
    3. the `RoundoffGuard` lets steps grow where the error is roundoff;
    4. the `EventBracket` ends steps at events that the stepper located;
    5. the `StiffnessGuard` ends the run where stability limits the steps, if another method is worth
       its own program from `stiff_steps` more steps on (None: not watched).

    `order` is that of the mean defect, `defect_order` that of its modulus; `first` and `longest` are
    the first and the largest step size, and `first_growth` limits the growth after the first step.
    Events are located if `locates`.
    """

    stops: jax.Array
    test: ErrorTest
    tangents: TangentLimit
    first: Any
    first_growth: Any
    longest: Any
    order: int = eqx.field(static=True)
    defect_order: int = eqx.field(static=True)
    locates: Any
    stiff_steps: Any = None

    adapts: ClassVar[bool] = True

    class State(NamedTuple):
        """The `end` of the next attempt, the step `size` that is planned, the number of the next
        `stop`, and the states of the parts: `decay` is that of the `TangentLimit`."""

        end: Any
        size: Any
        stop: Any
        budget: ErrorBudget
        growth: GrowthLimiter
        guard: RoundoffGuard
        event: jax.Array
        decay: Any
        stiffness: StiffnessGuard | None

    def init(self):
        first = lax.stop_gradient(jnp.minimum(self.first, self.longest))
        return self.State(
            end=clip_to_stop(self.stops[0], first, self.stops[1]),
            size=first,
            stop=jnp.asarray(1),
            budget=ErrorBudget.at_start(first),
            growth=GrowthLimiter.at_start(first),
            guard=RoundoffGuard.at_start(first),
            event=EventBracket.no_event(first).pack(),
            decay=jnp.zeros(2, jnp.result_type(first)),
            stiffness=None if self.stiff_steps is None else StiffnessGuard.at_start(),
        )

    def end(self, state):
        return state.end

    def next_size(self, state):
        return state.size

    def decide(self, t0, t1, x0, step, state):
        span = self.stops[-1] - self.stops[0]
        attempt = self.test.attempt(t0, t1, x0, step, span)

        # 1. Accept or reject.
        attempt = attempt.by_modulus(state.guard.noise_floor > 0.0, self.test.horizon)
        is_noise = state.guard.is_noise(attempt.modulus, self.defect_order)
        is_roundoff = lax.stop_gradient(is_noise & (attempt.error <= attempt.roundoff))
        covered = state.budget.covers(attempt, is_noise) | is_roundoff
        is_resolved = 4.0 * attempt.smallest <= trusted_length(span)
        crossing = state.budget.may_cross(attempt, is_resolved, step.unenclosed)
        excursion = self._excursion(x0, step, attempt, span)
        passes = (attempt.error <= 1.0) | covered | crossing
        known = EventBracket.unpack(state.event)
        tangent, decay, ends_at_kink = None, state.decay, False
        if step.fastest is not None:
            tangent = self.tangents.of(step.fastest, decay, attempt)
            passes = passes & tangent.is_short_enough
            ends_at_kink = ~tangent.may_cross & known.may_try()
        found = self._event(step, attempt, (excursion > 1.0) | ends_at_kink)
        if tangent is not None:
            passes = passes & ~(ends_at_kink & (found < jnp.inf))
        accepted = attempt.usable & passes & (excursion <= 1.0)
        budget = state.budget.after(attempt, accepted, covered, is_roundoff)

        # 2. Limit the growth of the step size.
        factor, limit = state.growth.factor(
            attempt, self.order, t0 == self.stops[0], self.first_growth
        )
        if step.excursion is not None:
            limit = limit_by_excursion(limit, excursion)
        attempt = attempt._replace(size=lax.stop_gradient(attempt.size))
        size = next_size(attempt, accepted, factor, limit)

        # 3. Let steps grow where errors are roundoff.
        guard = state.guard.after(
            attempt.size,
            attempt.modulus,
            accepted,
            state.growth.accepted_in_a_row,
            self.defect_order,
        )
        size = guard.lengthen(size, attempt.size, accepted)
        size = resume_planned(size, attempt, accepted, state.size)

        # 4. End steps at events. An event explains a rejection: the planned step size stays.
        rejected = ~accepted & attempt.usable & jnp.isfinite(attempt.error)
        event, directed = known.after(attempt, found, state.size, rejected)
        at_event = directed | (accepted & known.is_known())
        size = jnp.where(at_event, jnp.maximum(size, state.size), size)
        begin = jnp.where(accepted, t1, t0)
        event = EventBracket(*map(lax.stop_gradient, event.discard_passed(begin)))

        jumped = accepted & (t1 == self.stops[state.stop])
        last = self.stops.shape[0] - 1
        stop = jnp.minimum(jnp.where(jumped, state.stop + 1, state.stop), last)
        size = size if tangent is None else tangent.limit(size, attempt.size)
        size = jnp.minimum(jnp.maximum(size, attempt.smallest), self.longest)
        if step.fastest is not None:
            excited = accepted & (at_event | jumped)
            decay = self.tangents.after(step.fastest, decay, attempt.error, accepted, excited)
        exhausted = is_noise & ~is_roundoff & state.budget.is_exhausted() & state.guard.had_noise()
        new = self.State(
            end=clip_to_stop(begin, size, event.limit(begin, self.stops[stop])),
            size=size,
            stop=stop,
            budget=budget,
            growth=state.growth.after(accepted, directed, guard.wait),
            guard=guard,
            event=event.pack(),
            decay=decay,
            stiffness=None,
        )
        result = self._result(step, attempt, accepted, exhausted)

        # 5. End the run where stability limits the steps.
        if state.stiffness is not None and step.stiffness is not None:
            assert self.stiff_steps is not None
            stiffness = lax.stop_gradient(step.stiffness)
            if tangent is not None:
                stiffness = jnp.where(tangent.is_stiff, 1.0, stiffness)
            counts = accepted & ~at_event & jnp.isfinite(stiffness)
            votes = state.stiffness.after(stiffness, counts)
            remaining = (self.stops[-1] - t1) / attempt.size
            stiff = votes.fires(stiffness, counts, remaining, self.stiff_steps)
            result = RESULTS.where(stiff, RESULTS.stiff, result)
            new = new._replace(stiffness=votes)
        return StepDecision(accepted, new, jumped, result)

    def shorten(self, state: Any, time: Any, margin: Any) -> Any:
        """Return the state whose next attempt ends at time + margin, close behind an event."""
        # The step size that is planned stays, as at a kink.
        tries = EventBracket.unpack(state.event).tries
        event = EventBracket(time, margin, jnp.zeros_like(time), tries)
        return state._replace(end=time + margin, event=event.pack())

    def step_start(self, index, t):
        t = lax.stop_gradient(t)
        nearest = self.stops[jnp.argmin(jnp.abs(self.stops - t))]
        return jnp.where(jnp.abs(nearest - t) <= slack(t), nearest, t)

    def _excursion(self, x0: Tree, step: Step, attempt: Attempt, span: Any) -> Any:
        """Return by how much data may have moved unseen between the samples, 1 being the limit."""
        if step.excursion is None:
            return jnp.zeros_like(attempt.size)
        watched = attempt.size > trusted_length(span)
        return lax.stop_gradient(jnp.where(watched, self.test.excursion(x0, step), 0.0))

    def _event(self, step: Step, attempt: Attempt, is_too_long: Any) -> Any:
        """Return the time of the first event inside a step that `is_too_long` for it, or has too large
        an error; ∞ for none."""
        if step.event is None:
            return jnp.full_like(attempt.size, jnp.inf)
        wanted = (attempt.error > 1.0) | is_too_long
        return lax.stop_gradient(step.event(wanted & self.locates))

    def _result(self, step: Step, attempt: Attempt, accepted: Any, exhausted: Any) -> RESULTS:
        # A step size is rounded with the two times that it lies between.
        stuck = ~accepted & ((attempt.size <= 1.25 * attempt.smallest) | exhausted)
        finite = jnp.isfinite(attempt.error) | step.unenclosed
        reason = RESULTS.where(finite, RESULTS.step_too_small, RESULTS.nonfinite)
        reason = RESULTS.where(step.solved, reason, RESULTS.law_unsolved)
        result = RESULTS.where(stuck, reason, RESULTS.successful)
        result = RESULTS.where(step.start_solved, result, RESULTS.law_unsolved)
        return RESULTS.where(attempt.finite, result, RESULTS.nonfinite)
