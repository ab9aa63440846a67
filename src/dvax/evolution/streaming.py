"""A run whose saved rows go into a store, piece by piece.

A piece has as many rows as fit into 8 MB. It starts from the last state and step size of the one
before, and all pieces share one compiled program, so that the memory of a run does not grow with the
number of saved times.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, Protocol, runtime_checkable

import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from . import meter
from .results import is_success
from .rows import cut, with_fields
from .solution import Solution

_PIECE_BYTES = 2**23


@runtime_checkable
class Store(Protocol):
    """What `dvax.solve(save=…)` writes rows into, such as a `dvax.ZarrStore`."""

    def begin(self, count: int) -> None:
        """Make room for `count` rows."""
        ...

    def write(self, rows: Solution) -> None:
        """Append the rows of a solution."""
        ...

    def finish(self) -> None:
        """Complete the store with the rows that were written."""
        ...


_OTHERS = ("dense", "events", "certified_tol")


def check_save(save: Any, ts: Any, x0: Any, args: Any, others: tuple[bool, ...]) -> None:
    """Check the arguments of a run whose rows are saved; `others`: which of `_OTHERS` are given.

    **Raises:** `dvax.InputError`.
    """
    wrong = [name for name, is_given in zip(_OTHERS, others, strict=True) if is_given]
    place, rule, fix = "", "", ""
    if not isinstance(save, Store):
        place, given = "save", _tree.line(save)
        rule, fix = "it is a store with begin, write and finish", 'Pass dvax.ZarrStore("run.zarr")'
    elif not _tree.is_concrete(ts, x0, args):
        place, given = "save", "a run inside a compiled program or a derivative"
        rule, fix = "files are written by a run that is called as it is", "Leave out save="
    elif ts is None:
        place, given = "ts", "None"
        rule, fix = "save= writes the rows of the saved times", "Pass ts=np.linspace(t0, t1, 1001)"
    elif wrong:
        place, given = wrong[0], "together with save="
        rule, fix = (
            "the rows of the saved times are written, and nothing else",
            f"Leave out {wrong[0]}=",
        )
    if place:
        raise input_error(f"dvax.solve({place})", given, rule, fix)


def stream(
    run: Callable[..., Solution], x0: Tree, t0: float, t1: float, times: np.ndarray, dt0: Any,
    save: Store, fixed: bool, throw: bool, progress: bool,
) -> Solution:  # fmt: skip
    """Write the rows of a run into `save`, and return its end.

    `run(x, start, end, ts, dt0)` solves a piece. The solution that is returned has the last row alone,
    with the integrals of the defect and the counts of the whole run.

    **Raises:** `dvax.SolveError` where a piece fails, after the rows that were reached are saved.
    """
    save.begin(len(times))
    totals, began = _Totals(), meter.now()
    try:
        for piece, count in _pieces(run, x0, t0, t1, times, dt0, fixed):
            totals.add(piece)
            if count:
                save.write(totals.rows(slice(count)))
            if not is_success(piece.result):
                break
            if progress:
                done = math.floor(1000 * (float(piece.stats["t"]) - t0) / (t1 - t0))
                method = str(piece.stats["method"]).partition(":")[0]
                meter.show(method, done, totals.piece.stats["steps"], began)
    finally:
        save.finish()
    end = totals.rows(slice(max(count - 1, 0), count))
    if throw:
        end.raise_if_failed()
    return end


def _pieces(
    run: Callable[..., Solution], x0: Tree, t0: float, t1: float, times: np.ndarray, dt0: Any,
    fixed: bool,
) -> Iterator[tuple[Solution, int]]:  # fmt: skip
    """The solutions of the pieces, and how many of their rows are saved times of the run."""
    length = min(len(times), piece_length(x0))
    x, start, step = x0, t0, dt0
    for begin in range(0, len(times), length):
        wanted = times[begin : begin + length]
        # The last piece repeats its end, so that all have one length and share one compiled program.
        ts = np.concatenate([wanted, np.full(length - len(wanted), wanted[-1])])
        end = t1 if begin + length >= len(times) else float(ts[-1])
        piece = run(x, start, end, ts, step)
        yield with_fields(piece, {"law": piece.responses()}), min(len(piece.ts), len(wanted))
        x, start = piece.stats["x"], end
        step = None if fixed else float(piece.stats["next_dt"])


def piece_length(x0: Tree) -> int:
    """Return the number of rows of a piece."""
    row = sum(np.asarray(leaf).nbytes for leaf in jtu.tree_leaves(x0))
    return max(2, min(10_000, _PIECE_BYTES // max(1, row)))


class _Totals:
    """The last piece, with the integrals of the defect and the counts of the whole run so far."""

    def __init__(self) -> None:
        self.piece: Any = None

    def add(self, piece: Solution) -> None:
        before, self.piece = self.piece, piece
        if before is None:
            return
        fields: dict[str, Any] = {"setup": _longer(before.setup, piece.setup)}
        fields["enclosed"] = before.enclosed and piece.enclosed
        counts = {n: before.stats[n] + piece.stats[n] for n in _COUNTS if n in piece.stats}
        fields["stats"] = {**piece.stats, **counts}
        if piece.defect is not None and before.defect is not None:
            assert piece.completed_defect is not None and piece.law_defect is not None
            ends = before.defect[-1], before.law_defect[-1]
            fields["defect"] = piece.defect + ends[0]
            fields["law_defect"] = piece.law_defect + ends[1]
            fields["completed_defect"] = tuple(
                part + end for part, end in zip(piece.completed_defect, ends, strict=True)
            )
        self.piece = with_fields(piece, fields)

    def rows(self, which: slice) -> Solution:
        """Return these rows of the last piece."""
        return cut(self.piece, which)


_COUNTS = ("steps", "rejected", "evaluations", "compile_time", "run_time")


def _longer(before: Any, piece: Any) -> Any:
    """Return the setup of the whole run so far."""
    return before._replace(setting={**before.setting, "t1": piece.setting["t1"]})
