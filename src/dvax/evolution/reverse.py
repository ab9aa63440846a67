"""The reverse pass: the steps that were taken, seen from the end.

The steps of a run are a choice; given them, x₀, x₁, … is a recursion xᵢ₊₁ = Φᵢ(xᵢ, p), and a saved
state Ψ(xᵢ, p) belongs to the step that its time lies in. With λᵢ the derivative of what was asked for
with respect to xᵢ,

    λᵢ = (∂Φᵢ/∂x)ᵀ λᵢ₊₁ + Σ (∂Ψ/∂x)ᵀ ψ̄,      p̄ = Σᵢ (∂Φᵢ/∂p)ᵀ λᵢ₊₁ + Σ (∂Ψ/∂p)ᵀ ψ̄.

States are kept at checkpoints and computed again between them, in the places that the way back has
left free, so that memory is bounded whatever the number of steps. Only what a derivative is asked
for is differentiated.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax

from .. import _tree
from .._jax import outlined
from .._tree import Tree
from .checkpoints import Checkpoints, Stack, checkpoint_count
from .loop import Loop, Record, Saved, State
from .stepper import SolverState, dense_output
from .time_derivatives import instantiate_zeros, is_zero


def run(loop: Loop, x0: Tree, ts: jax.Array | None) -> tuple[Saved | None, State]:
    """`loop.run(x0, ts)`, with a reverse derivative for the states: those saved, those of the dense
    output, and the last. Of all the other things the derivative is zero."""
    dynamic, static = eqx.partition((x0, loop, ts), eqx.is_array)
    leaves, tree = jtu.tree_flatten(dynamic)
    # Which of them say where steps end, and which are data.
    _, numbered, _ = jtu.tree_unflatten(tree, range(len(leaves)))
    timing, own = jtu.tree_leaves(numbered.controller), numbered.stepper.flow
    data = jtu.tree_leaves((own.problem, own.args))

    def whole(leaves: Any) -> tuple[Tree, Loop, jax.Array | None]:
        return eqx.combine(jtu.tree_unflatten(tree, leaves), static)

    @jax.custom_vjp
    def solved(*leaves: jax.Array) -> Any:
        x0, loop, ts = whole(leaves)
        return _states(*outlined(Loop.run, loop, x0, ts))

    def forward(*given: Any) -> Any:
        leaves = [leaf.value for leaf in given]
        x0, loop, ts = whole(leaves)
        loop = loop.for_derivatives(x0, [given[k].perturbed for k in data])

        def run(loop: Loop, x0: Tree, ts: jax.Array | None) -> tuple[Saved | None, State]:
            return loop.run(x0, ts, Checkpoints(x0, checkpoint_count(x0, loop.max_steps)))

        saved, state = outlined(run, loop, x0, ts)
        assert state.checkpoints is not None
        moving = _tree.Static(tuple(leaf.perturbed for leaf in given))
        met = None if saved is None else saved.step
        rows = None
        if state.watched is not None:
            rows = state.watched.rows._replace(x=None), state.watched.count
        kept = leaves, moving, state.ends, state.checkpoints, state.steps, met, rows
        states, rest = _states(saved, state)
        return (states, rest), kept

    def backward(kept: Any, cotangents: Any) -> Any:
        leaves, moving, *history = kept

        def run(leaves: Any, bar: _States, *history: Any) -> tuple[Any, ...]:
            return _Backward(whole, leaves, moving.value, timing, *history).run(bar)

        bar = _States(*map(_given, cotangents[0]))
        return outlined(run, leaves, bar, large=tuple(history))

    solved.defvjp(forward, backward, symbolic_zeros=True)
    states, rest = solved(*leaves)
    return _rejoin(states, rest)


class _States(NamedTuple):
    """What has a derivative."""

    last: Tree
    saved: Tree | None
    records: Record | None
    events: Tree | None

    @property
    def of_insides(self) -> bool:
        """Whether anything within steps has one, not their ends alone."""
        return any(v is not None for v in (self.saved, self.records, self.events))


def _states(saved: Saved | None, state: State) -> tuple[_States, Any]:
    """The run's answer taken apart into what has a derivative and what has none."""
    watched, events = state.watched, None
    if watched is not None:
        events = watched.rows.x
        watched = watched._replace(rows=watched.rows._replace(x=None))
    states = _States(state.x, None if saved is None else saved.x, state.records, events)
    # Of the solver's state, the run returns the guess for the law.
    guess = SolverState(None, state.solver_state.guess, None, None)
    state = state._replace(
        x=None, solver_state=guess, propagators=None, last=None, ends=None, checkpoints=None,
        meter=None, records=None, watched=watched,
    )  # fmt: skip
    return states, (None if saved is None else saved._replace(x=None), state)


def _rejoin(states: _States, rest: Any) -> tuple[Saved | None, State]:
    saved, state = rest
    if saved is not None:
        saved = saved._replace(x=states.saved)
    watched = state.watched
    if watched is not None:
        watched = watched._replace(rows=watched.rows._replace(x=states.events))
    return saved, state._replace(x=states.last, records=states.records, watched=watched)


class _Backward:
    """The pass itself, for one run and what is asked of it."""

    def __init__(self, whole, leaves, moving, timing, ends, checkpoints, steps, met, events):
        self.events, self.whole, self.leaves = events, whole, leaves
        real = [jnp.issubdtype(leaf.dtype, jnp.inexact) for leaf in leaves]
        self.moving = [m and r for m, r in zip(moving, real, strict=True)]
        self.ends, self.checkpoints, self.steps, self.met = ends, checkpoints, steps, met
        self.x0, self.loop, self.ts = whole(leaves)
        self.guess = self.loop.stepper.flow.guess(self.x0)
        self.ends_move = any(self.moving[k] for k in timing)
        self.fixed = [leaf for leaf, m in zip(leaves, self.moving, strict=True) if not m]

    def run(self, bar: _States) -> tuple[Any, ...]:
        """The cotangents of the leaves."""
        moving = tuple(leaf for leaf, m in zip(self.leaves, self.moving, strict=True) if m)
        adjoint = bar.last if bar.last is not None else _tree.zeros_like(self.x0)
        row = -1 if self.ts is None else self.ts.shape[0] - 1
        carry = (
            adjoint,
            jtu.tree_map(jnp.zeros_like, moving),
            (jnp.asarray(row), None if self.events is None else self.events[1] - 1),
            self.guess,
        )
        every = checkpoint_count(self.x0, self.loop.max_steps) >= self.loop.max_steps
        carry = self._through_all(bar, carry) if every else self._from_checkpoints(bar, carry)
        adjoint, gathered, (row, _), _ = carry
        if bar.saved is not None:
            # Saved times at which no step had been taken show x₀ itself.
            assert self.ts is not None
            early = jnp.arange(self.ts.shape[0]) <= row
            pick = lambda v: jnp.where(early.reshape(-1, *(1,) * (v.ndim - 1)), v, 0.0)  # noqa: E731
            first = jtu.tree_map(lambda v: jnp.sum(pick(v), axis=0), bar.saved)
            adjoint = _tree.add(adjoint, first)
        gathered = iter(gathered)
        out = [
            next(gathered) if m else _no_tangent(leaf)
            for leaf, m in zip(self.leaves, self.moving, strict=True)
        ]
        return tuple(self._add_initial(out, adjoint))

    def _through_all(self, bar: _States, carry: Any) -> Any:
        """Where every state was kept. (A loop inside would make a small step many times as long.)"""

        def one(carry: Any) -> Any:
            i, inner = carry
            return i - 1, self._step_back(i, self.checkpoints.before(i)[1], bar, *inner)

        return lax.while_loop(lambda c: c[0] >= 0, one, (self.steps - 1, carry))[1]

    def _from_checkpoints(self, bar: _States, carry: Any) -> Any:
        """Where states are computed again."""

        def one(carry: Any) -> Any:
            i, stack, inner = carry
            stack = lax.while_loop(lambda s: s.step < i, partial(self._climb, i), stack)
            return i - 1, stack.pop(), self._step_back(i, stack.x, bar, *inner)

        start = self.steps - 1, self.checkpoints.stack(self.steps), carry
        return lax.while_loop(lambda c: c[0] >= 0, one, start)[2]

    def _climb(self, i: Any, stack: Stack) -> Stack:
        """One more state kept, towards the one that step i begins with."""
        ahead = stack.next(i)
        return stack.push(ahead, self._replay(stack.x, stack.step, ahead))

    def _add_initial(self, out: list[Any], adjoint: Tree) -> list[Any]:
        """The first leaves are those of x₀."""
        for k, part in enumerate(jtu.tree_leaves(adjoint)):
            if self.moving[k]:
                out[k] = out[k] + part
        return out

    def _parts(self, moving: Any) -> Loop:
        """The loop with these numbers in the place of those that are differentiated."""
        ours, theirs = iter(moving), iter(self.fixed)
        return self.whole([next(ours if m else theirs) for m in self.moving])[1]

    def _times(self, loop: Loop, i: Any) -> tuple[Any, Any]:
        controller = loop.controller
        t0, t1 = jnp.zeros(2) if self.ends is None else (self._before(i), self.ends[i])
        return controller.step_start(i, t0), controller.step_start(i + 1, t1)

    def _before(self, i: Any) -> Any:
        return jnp.where(i > 0, self.ends[jnp.maximum(i - 1, 0)], self.loop.controller.stops[0])

    def _advance(self, loop: Loop, i: Any, x: Tree, guess: Tree | None) -> tuple[Any, Any]:
        """(xᵢ₊₁, c, the end of the step before its events reset it), and a guess for the law of another
        step."""
        t0, t1 = self._times(loop, i)
        stepper = loop.stepper
        propagators = stepper.uniform
        if propagators is None and not stepper.method.is_rosenbrock:
            propagators = stepper.propagators(t1 - t0)
        x1, c, y = stepper.advance(t0, t1, x, propagators, guess)
        behind = x1
        if self.events is not None:
            assert loop.watch is not None
            rows, count = self.events
            fired, widths = loop.watch.fired(rows, count, i)
            behind, _ = loop.watch.jump(stepper.flow, t1, x1, fired, widths, guess)
        return (behind, c, x1), None if guess is None else lax.stop_gradient(y)

    def _replay(self, x: Tree, i: Any, until: Any) -> Tree:
        """x_until from xᵢ."""

        def one(carry: Any) -> Any:
            i, x, guess = carry
            (x, *_), guess = self._advance(self.loop, i, x, guess)
            return i + 1, x, guess

        return lax.while_loop(lambda c: c[0] < until, one, (i, x, self.guess))[1]

    def _step_back(
        self, i: Any, x: Tree, bar: _States, adjoint: Tree, gathered: Any, row: Any, guess: Any
    ) -> tuple[Any, ...]:
        """λᵢ from λᵢ₊₁, with what this step adds to the rest."""
        moving = tuple(leaf for leaf, m in zip(self.leaves, self.moving, strict=True) if m)

        def step(p: Any, x: Tree) -> tuple[Any, Any]:
            (x1, c, end), after = self._advance(self._parts(p), i, x, guess)
            return ((x1, c, end) if bar.of_insides else (x1,)), (c, after)

        _, pull, (c, guess) = jax.vjp(step, moving, x, has_aux=True)
        row, event = row
        bent, at_end = _tree.zeros_like(c), _tree.zeros_like(x)
        behind = _tree.zeros_like(x)
        if bar.records is not None:
            kept = jtu.tree_map(lambda leaf: leaf[i], bar.records)
            behind, bent = kept.x0, kept.coefficients
            gathered = self._recorded(kept, i, moving, gathered)
        if bar.saved is not None:
            adjoint, behind, bent, gathered, row = self._saved_back(
                i, x, c, moving, bar.saved, (adjoint, behind, bent, gathered, row)
            )
        if bar.events is not None:
            behind, bent, at_end, gathered, event = self._events_back(
                i, x, c, moving, bar.events, (behind, bent, at_end, gathered, event)
            )
        p, x = pull((adjoint, bent, at_end) if bar.of_insides else (adjoint,))
        return _tree.add(behind, x), jtu.tree_map(jnp.add, gathered, p), (row, event), guess

    def _recorded(self, kept: Record, i: Any, moving: Any, gathered: Any) -> Any:
        """Where a kept step begins, and its length."""
        if not self.ends_move:
            return gathered

        def step(p: Any) -> tuple[Any, Any]:
            t0, t1 = self._times(self._parts(p), i)
            return t0, t1 - t0

        _, pull = jax.vjp(step, moving)
        return jtu.tree_map(jnp.add, gathered, pull((kept.start, kept.length))[0])

    def _saved_back(self, i: Any, x: Tree, c: Any, moving: Any, saved: Tree, carry: Any) -> Any:
        """The times saved in this step from x, the last ones first."""
        assert self.ts is not None
        ts, (t0, _) = lax.stop_gradient(self.ts), self._times(self.loop, i)

        def one(carry: Any) -> Any:
            adjoint, behind, bent, gathered, row = carry
            psi = jtu.tree_map(lambda leaf: leaf[row], saved)

            def inside() -> Any:
                p, v, d = self._pull_inside(i, ts[row], moving, x, c, psi)
                return adjoint, _tree.add(behind, v), _tree.add(bent, d), _tree.add(gathered, p)

            def at_end() -> Any:
                return _tree.add(adjoint, psi), behind, bent, gathered

            return *lax.cond(self.met[row] == i + 1, at_end, inside), row - 1

        def goes_on(carry: Any) -> Any:
            row = carry[-1]
            is_inside = (self.met[row] < 0) & (ts[row] > t0)
            return (row >= 0) & (is_inside | (self.met[row] == i + 1))

        return lax.while_loop(goes_on, one, carry)

    def _events_back(
        self, i: Any, x: Tree, c: Any, moving: Any, events: Tree, carry: Any
    ) -> tuple[Any, ...]:
        """The events of this step from x, the last ones first."""
        rows, _ = self.events

        def one(carry: Any) -> Any:
            behind, bent, at_end, gathered, row = carry
            psi = jtu.tree_map(lambda leaf: leaf[row], events)

            def inside() -> Any:
                p, v, d = self._pull_inside(i, rows.time[row], moving, x, c, psi)
                return _tree.add(behind, v), _tree.add(bent, d), at_end, _tree.add(gathered, p)

            def end() -> Any:
                return behind, bent, _tree.add(at_end, psi), gathered

            return *lax.cond(rows.at_end[row], end, inside), row - 1

        goes_on = lambda carry: (carry[-1] >= 0) & (rows.step[carry[-1]] == i)  # noqa: E731
        return lax.while_loop(goes_on, one, carry)

    def _pull_inside(self, i: Any, time: Any, moving: Any, x: Tree, c: Any, psi: Tree) -> Any:
        """The cotangents of the parameters, xᵢ and c of a state inside of step i."""

        def at(p: Any, x: Tree, c: Any) -> Tree:
            loop = self._parts(p)
            t0, t1 = self._times(loop, i)
            stepper = loop.stepper
            step, method, ends = Record(t0, t1 - t0, x, c), stepper.method, stepper.ends
            states = dense_output(method, stepper.flow, step, self.guess, ends, t1)
            return states((time - t0) / (t1 - t0))

        _, pull = jax.vjp(at, moving, x, c)
        return pull(psi)


def _given(cotangents: Any) -> Any:
    """None where none of them is asked for."""
    if all(map(is_zero, jtu.tree_leaves(cotangents, is_leaf=is_zero))):
        return None
    return instantiate_zeros(cotangents)


def _no_tangent(leaf: Any) -> Any:
    if jnp.issubdtype(leaf.dtype, jnp.inexact):
        return jnp.zeros_like(leaf)
    return np.zeros(leaf.shape, jax.dtypes.float0)
