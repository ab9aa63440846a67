"""The evaluations of f̃ that a step needs, one after the other."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._batch import any_lane
from .._jax.jaxprs import count_operations
from .._tree import Tree
from .flow import Flow, Rate

_MAX_ENTRIES, _MAX_OPERATIONS = 64, 100
"""f̃ is in the program once if the state has no more entries than this, and f̃ more operations."""


class Evaluation(NamedTuple):
    """Where f̃ was evaluated, and what it was."""

    t: Any
    x: Tree
    rate: Rate


Stages = Callable[[Callable[[Any, Tree], Rate]], tuple[tuple[Tree, ...], Tree]]
"""From evaluate(t, x) to (the stage polynomial, x₁)."""

Evaluated = tuple[tuple[tuple[Tree, ...], Tree], list[Evaluation]]
"""What a plan comes to, and where it went."""


class _Reached(Exception):
    """(t, x) of the evaluation that was looked for."""


def evaluated(
    flow: Flow,
    plan: Stages,
    begin: Any,
    x0: Tree,
    guess: Tree | None,
    kept: Rate | None,
    jumped: Any,
) -> Evaluated:
    """A plan carried out from x₀, its first rate being `kept` (None: unknown), unless data `jumped`.
    `begin` is any time of the run."""
    # A step whose defect is enclosed has few evaluations, and its first rate lacks the solution of the
    # law, which the loop would store.
    if not flow.iterates and (flow.enclosed or not _is_long(flow, begin, x0)):
        return _straight(flow, plan, kept, jumped)
    return _in_turn(flow, plan, begin, x0, guess, kept, jumped)


def _is_long(flow: Flow, t: Any, x: Tree) -> bool:
    """Return whether f̃ is many operations on few numbers, as the formula for a box in two dimensions
    is: a compiler then takes most of its time for the copies of f̃."""
    if not _has_few_entries(x):
        return False
    return count_operations(jax.make_jaxpr(lambda: flow.rate(t, x, None))()) > _MAX_OPERATIONS


def _has_few_entries(x: Tree) -> bool:
    return sum(jnp.size(leaf) for leaf in jtu.tree_leaves(x)) <= _MAX_ENTRIES


def _straight(flow: Flow, plan: Stages, kept: Rate | None, jumped: Any) -> Evaluated:
    evaluations: list[Evaluation] = []

    def evaluate(t: Any, x: Tree) -> Rate:
        look = lambda: flow.rate(t, x, None)  # noqa: E731
        if kept is None:
            rate = look()
        else:
            rate = _stored(t, look) if evaluations else _unless(jumped, kept, look)
        evaluations.append(Evaluation(t, x, rate))
        return rate

    found = plan(evaluate)
    if kept is not None:
        found = _stored(evaluations[0].t, lambda: found)
    return found, evaluations


def _stored(t: Any, compute: Callable[[], Tree]) -> Tree:
    """Return compute(), NaN where t is NaN.

    The conditional makes XLA store the result. Without it, every expression that uses an evaluation
    contains it, with those before it: measured steps of DormandPrince with 100 unknowns take 7 times
    longer. Steps that are not measured use each of them once, and are faster as one expression.
    """

    def invalid() -> Tree:
        shapes = jax.eval_shape(compute)
        fill = lambda s: jnp.nan if jnp.issubdtype(s.dtype, jnp.inexact) else 0  # noqa: E731
        return jtu.tree_map(lambda s: jnp.full(s.shape, fill(s), s.dtype), shapes)

    return lax.cond(jnp.isnan(t), invalid, compute)


def _unless(jumped: Any, kept: Rate, look: Callable[[], Rate]) -> Rate:
    """The rate that is known, or of a new one as much as is kept of it."""

    def again() -> Rate:
        new = look()
        return new._replace(
            y=None if kept.y is None else new.y, z=None if kept.z is None else new.z
        )

    return lax.cond(jumped, again, lambda: kept)


def _in_turn(
    flow: Flow,
    plan: Stages,
    begin: Any,
    x0: Tree,
    guess: Tree | None,
    kept: Rate | None,
    jumped: Any,
) -> Evaluated:
    """The same by a loop that evaluates f̃ at one place of the program.

    A law that is solved by iteration takes a compiler a second or ten, once for every place, and a long
    formula nearly as much. So the plan is run again for every evaluation, with the rates known so far,
    to see where it goes next; of all that it computes the compiler keeps what leads there.

    The law is solved from what is known of y at that time, and not from where the plan went last: it
    may go to the end of the step for a stage, then inside, and to the end again.
    """

    def run(known: Callable[[int], Rate]) -> Evaluated:
        evaluations: list[Evaluation] = []

        def answer(t: Any, x: Tree) -> Rate:
            evaluations.append(Evaluation(t, x, known(len(evaluations))))
            return evaluations[-1].rate

        return plan(answer), evaluations

    def row(table: Rate, k: Any) -> Rate:
        return jtu.tree_map(lambda leaf: leaf[k], table)

    def visit(i: int, table: Rate) -> tuple[Any, Tree]:
        """(t, x) of evaluation i: the plan is traced up to there only."""
        count = 0

        def answer(t: Any, x: Tree) -> Rate:
            nonlocal count
            if count == i:
                raise _Reached(t, x)
            count += 1
            return row(table, count - 1)

        try:
            plan(answer)
        except _Reached as at:
            return at.args
        raise AssertionError("the plan makes the same evaluations in every run")

    like = jax.eval_shape(lambda: flow.rate(begin, x0, guess))
    blank = jtu.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), like)
    times = [visit.t for visit in run(lambda _: blank)[1]]
    count, times = len(times), lax.stop_gradient(jnp.stack(times))
    table = jtu.tree_map(lambda leaf: jnp.zeros((count, *leaf.shape), leaf.dtype), blank)
    start: Any = 0
    if kept is not None:
        table, start = _tree.put(table, 0, kept), jnp.where(any_lane(jumped), 0, 1)

    def one(k: Any, table: Rate) -> Rate:
        if _has_few_entries(x0):
            # All places at once are less to compile than a branch for each.
            places = [(place.t, place.x) for place in run(lambda i: row(table, i))[1]]
            t, x = jtu.tree_map(lambda *each: jnp.stack(each)[k], *places)
        else:
            t, x = lax.switch(k, [partial(visit, i) for i in range(count)], table)
        near = None if guess is None else _tree.where(k > 0, _along_line(times, table.y, k), guess)
        return _tree.put(table, k, flow.rate(t, x, near))

    table = lax.fori_loop(start, count, one, table)
    return run(lambda i: row(table, i))


def _along_line(times: jax.Array, rows: Tree, k: Any) -> Tree:
    """The rows before `k` at the time `times[k]`: on the line between the two around it, or the nearest
    one; the latest of those that have one time."""
    t, last = times[k], len(times) - 1
    known = jnp.arange(len(times)) < k
    early = jnp.where(known & (times <= t), times, -jnp.inf)
    late = jnp.where(known & (times >= t), times, jnp.inf)
    before, after = last - jnp.argmax(early[::-1]), last - jnp.argmin(late[::-1])
    before = jnp.where(early[before] > -jnp.inf, before, after)
    after = jnp.where(late[after] < jnp.inf, after, before)
    length = times[after] - times[before]
    share = jnp.where(length > 0, (t - times[before]) / jnp.where(length > 0, length, 1.0), 0.0)
    between = lambda leaf: (1.0 - share) * leaf[before] + share * leaf[after]  # noqa: E731
    return lax.stop_gradient(jtu.tree_map(between, rows))
