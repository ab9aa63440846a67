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

from dvax._tree import Label
from dvax.app.runs.applications.base import Plan
from dvax.app.runs.checkpoints import Checkpoint
from dvax.app.runs.interrupt import interruptible
from dvax.app.runs.solver_options import SEGMENTS
from dvax.errors import SolveError
from dvax.evolution import Implicit, Solution, solve
from dvax.evolution.responses import Responses
from dvax.evolution.rows import all_finite, cut, with_fields

_PIECE_BYTES = 2**20
"""The size of the states of a piece. With responses, variables and copies it was sixty times that."""


def segments(
    plan: Plan, first: int = 0, x: Any = None, step: Any = None, parts: int = SEGMENTS
) -> Iterator[Solution]:
    """The pieces of the solution from number `first` on, in order, each cut to its own times: from the
    state x and with the step size that the piece before ended with. There are about so many `parts`.

    **Raises:** `dvax.SolveError` after the last piece that was reached, the piece that failed (where
    it reached a saved time) included.
    """
    times = np.asarray(plan.times, float)
    t0, last = float(times[0]), float(times[-1])
    if len(times) == 1:
        return
    fixed = plan.settings.get("dt") is not None
    measure = {} if isinstance(plan.settings.get("method"), Implicit) else {"measure": True}
    length = segment_length(plan, parts)
    x = plan.x0 if first == 0 else x
    for begin in range(first * length, len(times), length):
        wanted = times[begin : begin + length]
        # Segments have one length, so that they share one compiled program: the last repeats its end.
        ts = np.concatenate([wanted, np.full(length - len(wanted), wanted[-1])])
        start = t0 if begin == 0 else float(times[begin - 1])
        if not start < ts[-1]:
            ts, wanted = ts[:1], wanted[:1]  # a single time, at the very start

        def piece(
            start: float = start, ts: np.ndarray = ts, x: Any = x, step: Any = step
        ) -> Solution:
            solution = solve(
                plan.problem, x, start, float(ts[-1]), plan.args, ts, constants=plan.constants,
                dt0=step, horizon=last - t0, **measure, **plan.settings,
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
        yield cut(solution, slice(len(wanted)))
        x, step = solution.stats["x"], None if fixed else float(solution.stats["next_dt"])


def segment_length(plan: Plan, parts: int = SEGMENTS) -> int:
    """The number of saved times of a piece: a share of 1/`parts`, fewer where states are large."""
    row = sum(np.asarray(leaf).nbytes for leaf in jtu.tree_leaves(plan.x0))
    return max(2, min(math.ceil(len(plan.times) / parts), _PIECE_BYTES // max(1, row)))


_SAVED = ("ts", "xs", "law", "defect", "law_defect", "completed_defect", "stats")


def to_checkpoint(piece: Solution) -> tuple[list[Any], dict[str, Any]]:
    """Return the arrays of a piece and facts about it, for a checkpoint: first the state at its end."""
    end = jtu.tree_leaves(piece.stats["x"])
    rows = jtu.tree_leaves({name: getattr(piece, name) for name in _SAVED})
    method = str(piece.stats["method"])
    return [*end, *rows], {"method": method, "enclosed": piece.enclosed, "parts": len(end)}


def end_of(saved: Checkpoint, plan: Plan) -> tuple[Any, float | None]:
    """Return the state and the step size with which the next piece begins."""
    parts = int(saved.about["parts"])
    x = jtu.tree_structure(plan.x0).unflatten([jnp.asarray(leaf) for leaf in saved.arrays[:parts]])
    step = saved.about["next_dt"]
    return x, None if step is None else float(step)


def from_checkpoint(saved: Checkpoint, like: Solution, plan: Plan) -> Solution:
    """Return the piece of a checkpoint; `like` is another piece of the same run."""
    # A piece in which the solve failed has no responses yet.
    like = with_fields(like, {"law": like.responses()})
    tree = jtu.tree_structure({name: getattr(like, name) for name in _SAVED})
    rows = map(jnp.asarray, saved.arrays[int(saved.about["parts"]) :])
    fields = tree.unflatten(rows)
    fields["stats"]["method"] = Label(saved.about["method"])
    setup = like.setup
    begin = max(0, saved.number * segment_length(plan) - 1)
    ends = {"t0": float(plan.times[begin]), "t1": float(np.asarray(fields["ts"])[-1])}
    setup = setup._replace(setting={**setup.setting, **ends})
    if saved.number == 0:
        # That of the whole run (`join_pieces`).
        setup = setup._replace(x0=jtu.tree_map(jnp.asarray, plan.x0))
    return with_fields(like, fields | {"setup": setup, "enclosed": bool(saved.about["enclosed"])})


def join_pieces(pieces: list[Solution], count: int | None = None) -> Solution:
    """Join consecutive pieces to one solution: integrals of defects are accumulated and steps are
    summed. Its `setup` is that of the first piece. With `count` it is padded to so many rows."""
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
    whole = with_fields(pieces[0], fields | {"enclosed": all(piece.enclosed for piece in pieces)})
    return whole if count is None else padded(whole, count)


def padded(solution: Solution, count: int) -> Solution:
    """Return the solution with its last row repeated up to `count` rows, so that programs of one length
    serve all partial results."""
    missing = count - len(solution.ts)
    if missing == 0:
        return solution

    def whole(rows: Any) -> jax.Array:
        rows = np.asarray(rows)
        return jnp.asarray(np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)]))

    names = "ts", "xs", "defect", "law_defect", "completed_defect"
    fields = {name: getattr(solution, name) for name in names} | {"law": solution.responses()}
    return with_fields(solution, jtu.tree_map(whole, fields))


def _concatenate(parts: list[Any]) -> Any:
    if any(part is None for part in parts):
        return None
    # By NumPy: JAX compiles a program for every number of pieces.
    return jtu.tree_map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *parts)
