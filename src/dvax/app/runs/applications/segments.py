"""A run in segments of its saved times: each starts from the last state and step size of the one
before.

Between two segments a run can report its progress and stop; the segments so far are a solution.
"""

import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from dvax.app.runs.applications.base import Plan, Results, Variable
from dvax.app.runs.interrupt import interruptible
from dvax.app.runs.solutions import all_finite, cut, with_fields
from dvax.app.runs.solver_options import SEGMENTS
from dvax.errors import SolveError
from dvax.evolution import Implicit, Solution, solve
from dvax.evolution.responses import Responses


def segments(plan: Plan) -> Iterator[Solution]:
    """The pieces of the solution, in order. Each is cut to its own times.

    **Raises:** `dvax.SolveError` after the last piece that was reached, the piece that failed (where
    it reached a saved time) included.
    """
    times = np.asarray(plan.times, float)
    first, last = float(times[0]), float(times[-1])
    if len(times) == 1:
        return
    fixed = plan.settings.get("dt") is not None
    measure = {} if isinstance(plan.settings.get("method"), Implicit) else {"measure": True}
    length = max(2, math.ceil(len(times) / SEGMENTS))
    x, step = plan.x0, None
    for begin in range(0, len(times), length):
        wanted = times[begin : begin + length]
        # Segments have one length, so that they share one compiled program: the last repeats its end.
        ts = np.concatenate([wanted, np.full(length - len(wanted), wanted[-1])])
        start = first if begin == 0 else float(times[begin - 1])
        if not start < ts[-1]:
            ts, wanted = ts[:1], wanted[:1]  # a single time, at the very start

        def piece(
            start: float = start, ts: np.ndarray = ts, x: Any = x, step: Any = step
        ) -> Solution:
            solution = solve(
                plan.problem, x, start, float(ts[-1]), plan.args, ts, constants=plan.constants,
                dt0=step, horizon=last - first, **measure, **plan.settings,
            )  # fmt: skip
            solution = all_finite(solution, start)
            # Here, where a signal can interrupt the compilation, and for all times of the segment,
            # whose number determines the program.
            return with_fields(solution, {"law": solution.responses()})

        try:
            solution = interruptible(piece)
        except SolveError as error:
            if isinstance(error.solution, Solution) and len(error.solution.ts):
                yield error.solution
            raise
        yield cut(solution, len(wanted))
        x, step = solution.stats["x"], None if fixed else float(solution.stats["next_dt"])


def join_pieces(pieces: list[Solution], count: int | None = None) -> Solution:
    """Join consecutive pieces to one solution: integrals of defects are accumulated and steps are
    summed. Its `setup` is that of the first piece. With `count` the last row is repeated up to that
    number, so that programs of one length serve all partial results."""
    fields: dict[str, Any] = {}
    for name in ("ts", "xs"):
        fields[name] = _concatenate([getattr(piece, name) for piece in pieces])
    laws = zip(*(piece.responses() for piece in pieces), strict=True)
    fields["law"] = Responses(*map(_concatenate, map(list, laws)))
    if pieces[0].defect is not None:
        defects: list[Any] = [(piece.defect, piece.law_defect) for piece in pieces]
        starts: list[Any] = [piece.completed_defect for piece in pieces]
        # The integrals at the start of each piece.
        ends = [np.array([float(one[-1]), float(two[-1])]) for one, two in defects]
        before = np.cumsum([np.zeros(2), *ends[:-1]], axis=0)
        sums = [
            tuple(
                _concatenate(
                    [np.asarray(part[k]) + at[k] for part, at in zip(parts, before, strict=True)]
                )
                for k in (0, 1)
            )
            for parts in (defects, starts)
        ]
        (fields["defect"], fields["law_defect"]), fields["completed_defect"] = sums
    last = pieces[-1].stats
    counts = {
        name: sum(int(p.stats[name]) for p in pieces)
        for name in ("steps", "rejected", "evaluations")
        if name in last
    }
    fields["stats"] = {**last, **counts}
    if count is not None:
        length = count

        def whole(rows: Any) -> jax.Array:
            return _padded(rows, length)

        stats = fields.pop("stats")
        fields = {**jtu.tree_map(whole, fields), "stats": stats}
    return with_fields(pieces[0], fields | {"enclosed": all(piece.enclosed for piece in pieces)})


def _padded(rows: Any, count: int) -> jax.Array:
    rows = np.asarray(rows)
    return jnp.asarray(np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)]))


def states_only(pieces: list[Solution]) -> Results:
    """Return times and states without figures, which needs no compilation."""
    parts = [jtu.tree_leaves(piece.xs) for piece in pieces]
    leaves = [np.concatenate([np.asarray(v) for v in part]) for part in zip(*parts, strict=True)]
    times = np.concatenate([np.asarray(piece.ts) for piece in pieces])
    variables = {"time": Variable(("time",), times, "", "time")}
    for k, leaf in enumerate(leaves):
        rows = leaf.reshape(len(leaf), -1)
        variables[f"{STATE}{k}"] = Variable(
            ("time", f"entry{k}"), rows, "", f"part {k} of the state"
        )
    return Results({}, variables, None, sum(int(piece.stats["steps"]) for piece in pieces))


STATE = "state_part"
"""The variable names of results that consist of states only."""


def _concatenate(parts: list[Any]) -> Any:
    if any(part is None for part in parts):
        return None
    # By NumPy: JAX compiles a program for every number of pieces.
    return jtu.tree_map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *parts)
