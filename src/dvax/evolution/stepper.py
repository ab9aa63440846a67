"""One step of an exponential method, as Diffrax's time loop asks for it."""

import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._tree import Tree
from ..generators import AbstractGenerator, AbstractPropagator, Growth
from ..problem import END_ULPS, KNOT_ULPS
from .chords import Chord, is_chord
from .flow import Flow, Rate
from .method import AbstractMethod, polynomial, shortened

_DOUBT = 4.0
"""By how many times its interpolation error z is taken to be uncertain between the samples."""

_SMALL = 64
"""Up to this many entries a look at every one of them is free."""


class Record(NamedTuple):
    """What is needed to evaluate a step anywhere inside: x₀ and the stage polynomial."""

    start: jax.Array
    length: jax.Array
    x0: Tree
    coefficients: tuple[Tree, ...]


class Carry(NamedTuple):
    """What the time loop carries and saves.

    `defect` = ∫ ‖p − f̃(·, x_h)‖ ds so far, so that x_h is the exact solution of the system with a
    disturbance of that size; `law_defect` = ∫ ‖w‖ ds, the same for the frozen solves; NaN where not
    measured. `before` is what both were at the start of the step that a saved time lies in: what has
    surely acted by then. `record` is the last step, kept only for dense output.
    """

    x: Tree
    defect: jax.Array
    law_defect: jax.Array
    record: Record | None
    before: tuple[jax.Array, jax.Array]


class Memory(NamedTuple):
    """What one step leaves to the next, each None where it is not needed: the rate at its end, a
    guess for the law, the propagators of its length, and the growth of the semigroup."""

    rate: Rate | None
    guess: Tree | None
    length: jax.Array | None
    full: AbstractPropagator | None
    half: AbstractPropagator | None
    growth: Growth | None


class Sample(NamedTuple):
    """The defect of one step: entry by entry for the step control, integrated for certificates."""

    last: Rate
    error: Tree
    defect: jax.Array
    law_defect: jax.Array


class MildTerm(diffrax.AbstractTerm):
    """The term Diffrax wants to be given. The mild form is not a vector field (A may be unbounded),
    so the dynamics live in the stepper, and this only says that there is one term."""

    def vf(self, t, y, args):
        return y

    def contr(self, t0, t1, **kwargs):
        return t1 - t0

    def prod(self, vf, control):
        return _tree.scale(control, vf)


class Interpolation(diffrax.AbstractPath):
    """The step evaluated anywhere inside: exact in A (see `AbstractMethod`)."""

    t0: Any
    t1: Any
    before: Carry
    after: Carry
    coefficients: tuple[Tree, ...]
    generator: AbstractGenerator

    def evaluate(self, t0, t1=None, left=True):
        theta = (t0 - self.t0) / (self.t1 - self.t0)
        x = inside(self.generator, self.t1 - self.t0, theta, self.before.x, self.coefficients)
        # At the end of the step the end itself: evaluating there would differ by rounding.
        x = _tree.where(theta >= 1.0, self.after.x, x)
        started = theta > 0.0
        return Carry(
            x,
            # Inside a step the bound of the whole step is charged: it can only be too large.
            jnp.where(started, self.after.defect, self.before.defect),
            jnp.where(started, self.after.law_defect, self.before.law_defect),
            self.after.record,
            _tree.where(
                theta >= 1.0,
                (self.after.defect, self.after.law_defect),
                (self.before.defect, self.before.law_defect),
            ),
        )


def inside(
    generator: AbstractGenerator, length: Any, theta: Any, x0: Tree, c: tuple[Tree, ...]
) -> Tree:
    """x_h(t₀ + θh)."""
    return generator.propagator(theta * length, len(c)).step(x0, shortened(c, theta))


class Stepper(diffrax.AbstractAdaptiveSolver):
    """A method bound to a flow.

    - `measure`: sample the defect inside every step, which adaptive steps and certificates need;
    - `careful`: on failure keep the last good state, at the price of a second pass over memory;
    - `ends`: first and last time of the run;
    - `uniform`: the propagator, where all steps have one length that is known beforehand.
    """

    method: AbstractMethod
    flow: Flow
    measure: bool = eqx.field(static=True)
    careful: bool = eqx.field(static=True)
    ends: tuple[Any, Any]
    uniform: AbstractPropagator | None = None

    term_structure: ClassVar = MildTerm

    @property
    def interpolation_cls(self) -> Callable[..., Interpolation]:
        return functools.partial(Interpolation, generator=self.flow.generator)

    def order(self, terms):
        return self.method.order

    def error_order(self, terms):
        # The estimate is the defect itself, which is of the method's order.
        return self.method.order

    def func(self, terms, t0, y0, args):
        return y0

    def init(self, terms, t0, t1, y0, args) -> Memory:
        t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
        h = t1 - t0
        guess = None if self.flow.direct else self.flow.problem.zero_control(y0.x)
        start = self._within(t0, t1, 0.0)
        rate = self._kept(self.flow.rate(start, y0.x, guess)) if self.measure else None
        half, growth = self._half(h), None
        if self.measure and self.flow.enclosed:
            # Once a run: for a matrix it takes an eigenvalue.
            growth = self.flow.generator.growth(self.flow.state_space(y0.x))
        if self.uniform is not None:
            return Memory(rate, guess, None, None, half, growth)
        return Memory(rate, guess, h, self._propagator(h), half, growth)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
        memory, h, x0 = solver_state, t1 - t0, y0.x
        if self.uniform is None:
            memory = self._fit(memory, t0, t1, h)
        full = memory.full if self.uniform is None else self.uniform
        assert full is not None
        first = self._first(self._within(t0, t1, 0.0), x0, memory, made_jump)
        stages = [first]

        def evaluate(theta: float, x: Tree) -> Tree:
            stages.append(self.flow.rate(self._within(t0, t1, theta), x, stages[-1].y))
            return stages[-1].value

        def to_end(c: tuple[Tree, ...]) -> Tree:
            return full.step(x0, c)

        c = self.method.coefficients(evaluate, to_end, first.value)
        x1 = to_end(c)
        if self.measure:
            sample = self._measure(t0, t1, x0, x1, first, c, memory)
            last, defect, law_defect = sample.last, sample.defect, sample.law_defect
            stages.append(last)
            # Further in, a bad value may come from a step that was too long: it is cut, not fatal.
            finite = _tree.all_finite(first.value)
        else:
            last, defect, law_defect = stages[-1], 0.0, 0.0
            # A look at a large state costs half a step, and a bad entry stays bad (x₁ contains
            # e^{hA}x₀), so `solve` looks at the end and, where it must, runs again carefully.
            look = self.careful or _size(x1) <= _SMALL
            finite = _tree.all_finite(x1) if look else jnp.asarray(True)

        solved = jnp.all(jnp.stack([stage.solved for stage in stages]))
        unsolved: Any = diffrax.RESULTS.nonlinear_max_steps_reached
        nonfinite: Any = diffrax.RESULTS.nonfinite
        result = diffrax.RESULTS.where(solved, diffrax.RESULTS.successful, unsolved)
        result = diffrax.RESULTS.where(finite, result, nonfinite)
        if self.careful:
            x1 = _tree.where(finite & solved, x1, x0)
        record = None if y0.record is None else Record(t0, h, x0, c)
        after = y0.defect + defect, y0.law_defect + law_defect
        y1 = Carry(x1, *after, record, after)
        estimate = None
        if self.measure:
            estimate = jtu.tree_map(jnp.zeros_like, y1)._replace(x=sample.error)
        memory = memory._replace(
            rate=self._kept(last) if self.measure else None,
            guess=None if self.flow.direct else last.y,
        )
        info = {"before": y0, "after": y1, "coefficients": c}
        return y1, estimate, info, memory, result

    def _first(self, start: Any, x0: Tree, memory: Memory, made_jump: Any) -> Rate:
        if memory.rate is None:
            return self.flow.rate(start, x0, memory.guess)
        kept = memory.rate
        # The last sample of the previous step was taken here, unless data jumps here.
        return lax.cond(
            made_jump, lambda: self._kept(self.flow.rate(start, x0, memory.guess)), lambda: kept
        )

    def _within(self, t0: Any, t1: Any, theta: float) -> Any:
        """t₀ + θh, with the ends approached from inside: data may jump there.

        A few roundings inside, since two records may round the same moment differently; at the ends
        of the run as many as `Problem.knots` leaves out.
        """
        if 0.0 < theta < 1.0:
            return t0 + theta * (t1 - t0)
        begin, end = self.ends
        at_end = (t0 == begin) if theta == 0.0 else (t1 == end)
        ulps = jnp.where(at_end, END_ULPS, KNOT_ULPS)
        inset = lax.stop_gradient(jnp.minimum(ulps * _ulp(t0, t1), 0.25 * (t1 - t0)))
        return t0 + inset if theta == 0.0 else t1 - inset

    def _propagator(self, h: Any) -> AbstractPropagator:
        return self.flow.generator.propagator(h, self.method.degree + 1)

    def _kept(self, rate: Rate) -> Rate:
        """What the next step needs of a rate: not the law behind it, where nothing samples it."""
        return rate._replace(y=None, z=None) if self.flow.enclosed else rate

    def _half(self, h: Any) -> AbstractPropagator | None:
        sampled = self.measure and not self.flow.enclosed
        return self._propagator(0.5 * h) if sampled else None

    def _fit(self, memory: Memory, t0: Any, t1: Any, h: Any) -> Memory:
        """Propagators for this length; kept from the last step where the length is the same.

        t₀ + h is rounded, so equal steps differ by an ulp of t: that is not a new length.
        """
        same = jnp.abs(h - memory.length) <= 2 * _ulp(t0, t1)
        length, full, half = lax.cond(
            same,
            lambda: (memory.length, memory.full, memory.half),
            lambda: (h, self._propagator(h), self._half(h)),
        )
        return memory._replace(length=length, full=full, half=half)

    def _measure(
        self, t0: Any, t1: Any, x0: Tree, x1: Tree, first: Rate, c: Any, memory: Memory
    ) -> Sample:
        last = self.flow.rate(self._within(t0, t1, 1.0), x1, first.y)
        if self.flow.enclosed:
            return self._enclosed(t0, t1, x0, x1, c, last, memory.growth)
        return self._sampled(t0, t1, x0, x1, first, c, memory, last)

    def _enclosed(
        self, t0: Any, t1: Any, x0: Tree, x1: Tree, c: Any, last: Rate, growth: Any
    ) -> Sample:
        """|δ(θ)| ≤ (1−θ)(|δ(0)| + dev) + θ(|δ(1)| + dev) entry by entry, with dev from chord
        arithmetic, since p is a line; so ∫‖δ‖ is at most the mean of the norms of the two brackets
        (the norm of their mean would be too little: ends may lie in different entries). δ(0) is
        rounding, unless data jumps where nobody said it would."""
        t0, t1, x0, x1, c, growth = lax.stop_gradient((t0, t1, x0, x1, c, growth))
        h, space = t1 - t0, self.flow.state_space(x0)
        bend = self.flow.generator.bend(h, x0, x1, c, space, growth)
        x = jtu.tree_map(Chord, x0, x1, bend)
        t = Chord(self._within(t0, t1, 0.0), self._within(t0, t1, 1.0), jnp.zeros_like(t0))
        along = self.flow.enclosure(t, x)
        at_start = jtu.tree_map(
            lambda q, p: jnp.abs(q.a - p) + q.dev, along, c[0], is_leaf=is_chord
        )
        at_end = jtu.tree_map(
            lambda q, p: jnp.abs(q.b - p) + q.dev, along, polynomial(c, 1.0), is_leaf=is_chord
        )
        error = _tree.scale(0.5, _tree.add(at_start, at_end))
        defect = 0.5 * h * (space.norm(at_start) + space.norm(at_end))
        return Sample(last, error, defect, jnp.zeros_like(defect))

    def _sampled(
        self,
        t0: Any,
        t1: Any,
        x0: Tree,
        x1: Tree,
        first: Rate,
        c: Any,
        memory: Memory,
        last: Rate,
    ) -> Sample:
        """The defect δ = p − f̃(·, x_h) at the start, the middle and the end of the step.

        Between the samples δ is taken to be a line plus a bump (a parabola, or the tent of a kink):
        then ∫|δ| ≤ h(½|δ(0)| + ½|δ(1)| + |δ(½) − ½(δ(0) + δ(1))|), whatever the place of the kink.
        δ(0) is zero for a method whose polynomial starts at f̃(t₀, x₀), as most do.
        """
        h = t1 - t0
        flow = self.flow
        assert memory.half is not None
        xm = memory.half.step(x0, shortened(c, 0.5))
        tm, te = self._within(t0, t1, 0.5), self._within(t0, t1, 1.0)
        middle = flow.rate(tm, xm, first.y)
        start = _tree.scale(0.5, _tree.sub(first.value, c[0]))
        end = _tree.scale(0.5, _tree.sub(last.value, polynomial(c, 1.0)))
        line = _tree.add(start, end)
        bump = _tree.sub(_tree.sub(middle.value, polynomial(c, 0.5)), line)

        # How well z, the unconstrained value of the law, is predicted in the middle.
        doubt = jtu.tree_map(
            lambda a, m, b: _DOUBT * (m - 0.5 * (a + b)), first.z, middle.z, last.z
        )
        unseen = jtu.tree_map(
            jnp.maximum, flow.hidden(tm, xm, middle, doubt), flow.hidden(te, x1, last, doubt)
        )
        error = jtu.tree_map(lambda *parts: sum(map(jnp.abs, parts)), start, end, bump, unseen)
        space = flow.state_space(x0)
        defect = h * sum(map(space.norm, (start, end, bump, unseen)))
        residuals = [first.residual, middle.residual, last.residual]
        law_defect = h * jnp.max(jnp.stack(residuals))
        return Sample(last, error, defect, law_defect)


def _ulp(t0: Any, t1: Any) -> Any:
    return jnp.finfo(t0.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))


def _size(x: Tree) -> int:
    return sum(leaf.size for leaf in jtu.tree_leaves(x))
