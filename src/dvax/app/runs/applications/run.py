"""A run of an application, in segments of its saved times, which are written while the run goes on."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dvax.app.runs.applications.base import Figure, Plan, Results, Variable
from dvax.app.runs.applications.certificate import Certificate
from dvax.app.runs.applications.config import ModelConfig
from dvax.app.runs.applications.segments import (
    end_of,
    from_checkpoint,
    join_pieces,
    padded,
    segment_length,
    segments,
    to_checkpoint,
)
from dvax.app.runs.interrupt import Work, interruptible, patience, writing
from dvax.app.runs.run import AbstractRun, Facts, Listener
from dvax.app.runs.rundir import FrameStore, new_store, recover_store
from dvax.errors import input_error
from dvax.evolution import Solution
from dvax.theory import Constants

_BUFFER_BYTES = 2**23
"""So much of pieces and rows is held until it is written."""
_COUNTS = ("states", "responses")
"""The sizes that the manifest has."""
_CHUNK_BYTES, _CHUNK_ROWS = 2**23, 10_000


class ApplicationRun(AbstractRun):
    """The plan, and what of it is solved.

    The rows of a piece are computed when it is solved, and appended to trajectory.zarr together with a
    checkpoint. A run that goes on computes the rows of its checkpoints again, which are pieces of the
    solution, and replaces the trajectory when it has as many as before."""

    config: ModelConfig

    def __init__(self, config: ModelConfig, tell: Listener):
        super().__init__(config, tell)
        self.model, self.wording = config.model, config.wording
        known = self.model.describe()
        about: dict[str, Any] = {"model": config.name, "title": config.title, "fit": self.model.fit}
        about |= {what: int(count) for what, count, _ in known.sizes if what in _COUNTS}
        rows = constant_rows(known.constants)
        self.facts = Facts(rows, known.assumptions, config.fingerprints(), known.notes, about)
        self.plan: Plan | None = None
        self.end: Solution | None = None
        self.bound: Certificate | None = None
        self.unsaved: dict[int, Solution] = {}
        self.unsaved_bytes = 0
        self.partial: Solution | None = None
        self.rows: list[dict[str, Variable]] = []
        self.store: FrameStore | None = None
        self.is_shown = False
        self.last: Work[Results] | None = None
        self.results: Results | None = None
        self.has_told = False  # the reason for which there are no figures

    def begin(self) -> None:
        self.path = self.directory.path / "trajectory.zarr"
        recover_store(self.path)
        # Each checkpoint is a piece of the solution.
        self.saved = [c for k, c in enumerate(self.saved) if c.number == k]

    def solve(self) -> None:
        plan = self.plan = interruptible(lambda: self.model.plan(self._stage))
        length = segment_length(plan)
        # One piece is solved at least: the others are made like it.
        saved = self.saved[: -(-len(plan.times) // length) - 1]
        x, step = end_of(saved[-1], plan) if saved else (None, None)
        if saved:
            self.tell_resumed(float(plan.times[len(saved) * length - 1]), plan.time_unit)
        if len(plan.times) == 1:
            self._take(None, 1)
            self._show()
        for number, piece in enumerate(segments(plan, len(saved), x, step), start=len(saved)):
            is_first = number == len(saved)
            for checkpoint in saved if is_first else ():
                earlier = from_checkpoint(checkpoint, piece, plan)
                self._take(earlier, len(earlier.ts))
            self._take(piece, len(piece.ts))
            # The piece in which a solve failed has fewer rows, and no run can resume after it.
            if len(piece.ts) == len(plan.times[number * length : (number + 1) * length]):
                self.unsaved[number] = piece
                self.unsaved_bytes += _bytes(piece)
            else:
                self.partial = piece
            if is_first:
                self._show()
                # Compile all programs of the figures now, so that they need no time after an interrupt.
                self._figures()
                self.last = None
                self.event("compiled", compile_seconds=self.compiling())
            begin, t = float(plan.times[0]), float(piece.ts[-1])
            self.event(
                "progress", t=t - begin, t_end=float(plan.times[-1]) - begin, steps=self.steps,
                method=self.method, unit=plan.time_unit,
            )  # fmt: skip
            if self.checkpoints.is_due() or self.unsaved_bytes > _BUFFER_BYTES:
                self.try_checkpoint()
        self._stage("writing the results")
        self._flush()
        self.results = self._figures()

    def _figures(self) -> Results:
        """Return the results of the rows in the store. An error of the user's figures ends the run."""
        self.last = Work(self._compute())
        try:
            return self.last.result()
        except Exception:
            self.has_told = True
            raise

    def _take(self, piece: Solution | None, count: int) -> None:
        """Compute the rows of the next piece."""
        assert self.plan is not None
        length = segment_length(self.plan)

        def compute() -> tuple[Any, ...]:
            end = None if piece is None else padded(piece, length)
            bound = self.model.bound(end, self.bound)
            return end, bound, self.model.rows(end, bound, count)

        self.end, self.bound, rows = interruptible(compute)
        self.rows.append(rows)
        if piece is not None:
            self.steps += int(piece.stats["steps"])
            self.method = str(piece.stats["method"])
        if sum(v.values.nbytes for rows in self.rows for v in rows.values()) > _BUFFER_BYTES:
            self._flush()

    def _flush(self) -> None:
        """Append the rows that were computed to the store. **Raises:** `OSError`."""
        if not self.rows:
            return
        assert self.plan is not None
        rows = {
            name: replace(v, values=np.concatenate([each[name].values for each in self.rows]))
            for name, v in self.rows[-1].items()
        }
        if self.store is None:
            attrs = {"title": self.facts.model["title"], "model": self.config.name}
            fixed = interruptible(lambda: self.model.fixed(self.end))  # pyright: ignore
            self.store = open_store(new_store(self.path), len(self.plan.times), rows, fixed, attrs)
        for name, v in rows.items():
            if v.status:
                self.store.mark((name,), v.status)
        axis = self.store.axis
        self.store.write(rows[axis].values, {n: v.values for n, v in rows.items() if n != axis})
        self.rows = []

    def _show(self) -> None:
        """Put the store in the place of that of an earlier run, of which it has all rows."""
        self._flush()
        assert self.store is not None
        self.store.move(self.path)
        self.is_shown = True

    def checkpoint(self) -> None:
        if self.plan is None or not self.is_shown:
            return
        self._flush()
        fixed = self.plan.settings.get("dt") is not None
        for number, piece in list(self.unsaved.items()):
            arrays, about = to_checkpoint(piece)
            next_dt = None if fixed else float(piece.stats["next_dt"])
            self.checkpoints.save(number, arrays, about | {"next_dt": next_dt})
            del self.unsaved[number]
            self.unsaved_bytes -= _bytes(piece)

    def reached(self) -> str:
        if self.plan is None or self.end is None or not self.is_shown:
            return " before there were results"
        unit, end = f" {self.plan.time_unit}".rstrip(), float(self.plan.times[-1])
        t = float(self.end.ts[-1])
        return f" at t = {t:.10g} of {end:.10g}{unit}; what was saved is kept"

    def gather(self) -> str:
        if self.results is not None or not self.is_shown:
            return ""
        if self.has_told:
            return "Its figures are missing."
        with writing():
            self._flush()
        try:
            work = self.last or Work(self._compute())
            self.results = work.result(patience())
        except (KeyboardInterrupt, TimeoutError):
            return "Its figures are missing: there was no time for them."
        except Exception as error:  # noqa: BLE001 (of the user's figures, say; the reason names it)
            return f"Its figures are missing: they failed with {type(error).__name__}: {error}"
        return ""

    def write(self) -> tuple[Mapping[str, Figure], bool]:
        if self.store is None or not self.is_shown:
            return {}, False
        results = self.results
        if results is not None:
            self.store.put({name: np.asarray(v.values) for name, v in results.fixed.items()})
            files = list(results.files(self.directory.path))
            self.facts = replace(self.facts, model={**self.facts.model, "files": files})
        self.store.finish()
        return {} if results is None else results.figures, True

    def _compute(self) -> Callable[[], Results]:
        """Return a function that computes the results of the rows in the store."""
        assert self.store is not None
        series, end, bound = self.store.series(), self.end, self.bound
        whole = self._whole(series[self.store.axis]) if self.model.whole else lambda: end
        return lambda: self.model.results(series, whole(), bound)

    def _whole(self, times: np.ndarray) -> Callable[[], Solution]:
        """Return a function that reads and joins the pieces with these times. Their last row is
        repeated up to the number of times of the plan, so that one compiled program serves all partial
        results."""
        assert self.plan is not None and self.end is not None
        plan, like, unsaved = self.plan, self.end, list(self.unsaved.values())
        count = 0 if 0 in self.unsaved else min(self.unsaved, default=len(times))
        unsaved += [] if self.partial is None else [self.partial]

        def join() -> Solution:
            saved = self.checkpoints.load()[0] if count else []
            pieces = [from_checkpoint(c, like, plan) for c in saved if c.number < count] + unsaved
            found = np.concatenate([np.asarray(piece.ts) for piece in pieces])
            if not np.array_equal(found, times):
                raise input_error(
                    str(self.checkpoints.folder), f"{len(found)} of {len(times)} saved times",
                    "figures of the whole solution need the checkpoints of all its pieces",
                    f"Run dvax resume {self.directory.path}, which solves what is missing",
                )  # fmt: skip
            return join_pieces(pieces, len(plan.times))

        return join

    def _stage(self, words: str) -> None:
        self.event("stage", stage=words)


def _bytes(piece: Solution) -> int:
    """Return the size of the rows of a piece."""
    return sum(np.asarray(array).nbytes for array in to_checkpoint(piece)[0])


_ORDER = "variable_order"


def constant_rows(constants: Constants | None) -> list[dict[str, Any]]:
    """The table of constants; an application's units are those of its own description."""
    if constants is None:
        return []
    return [{**row._asdict(), "unit": ""} for row in constants.table()]


def open_store(
    path: Path, frames: int, rows: Mapping[str, Variable], fixed: Mapping[str, Variable],
    attrs: Mapping[str, Any],
) -> FrameStore:  # fmt: skip
    """Make a store of so many frames, for variables like these `rows`, the first of which has the
    saved times, and with the `fixed` ones."""
    every = {**rows, **fixed}
    axis = next(iter(rows))
    coordinates = [name for name, v in every.items() if v.dims == (name,)]
    # A store lists its arrays in no order.
    about = {**attrs, "coordinates": " ".join(coordinates), _ORDER: list(every)}
    of_row = max(v.values.nbytes // max(1, len(v.values)) for v in rows.values())
    block = max(1, min(frames, _CHUNK_ROWS, _CHUNK_BYTES // max(1, of_row)))

    def meta(v: Variable) -> dict[str, Any]:
        known = {"status": v.status} if v.status else {}
        return {"long_name": v.words, "units": v.unit, **known}

    return FrameStore(
        path, frames, block,
        {n: (v.dims, np.asarray(v.values), meta(v)) for n, v in fixed.items()},
        {n: (v.dims, v.values.dtype, meta(v)) for n, v in rows.items() if n != axis},
        about, meta(rows[axis]), axis=axis,
        sizes={
            dim: length
            for v in rows.values()
            for dim, length in zip(v.dims[1:], v.values.shape[1:], strict=True)
        },
    )  # fmt: skip
