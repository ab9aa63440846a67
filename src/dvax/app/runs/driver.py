"""`run`: from a checked configuration to a run directory, block by block of saved frames.

The trajectory is never held as a whole: a block of frames is solved, certified, written, forgotten.
Every block starts from the last state and step of the one before, so a run is the same whatever its
blocks, and what is on disk is readable whenever and however the run ends.
"""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from dvax import vi
from dvax.app.runs.blocks import block_length
from dvax.app.runs.compile_time import announced, compile_clock
from dvax.app.runs.config import Config, build_contact
from dvax.app.runs.contact_figures import Figures
from dvax.app.runs.contact_frames import (
    attributes,
    block_values,
    constant_rows,
    coordinates,
    variables,
)
from dvax.app.runs.contact_inputs import ContactInputs
from dvax.app.runs.contact_model import assumptions, contact_model
from dvax.app.runs.interrupt import Work, exit_code, interruptible, terminable, writing
from dvax.app.runs.provenance import provenance
from dvax.app.runs.resolved import write_resolved
from dvax.app.runs.rundir import FrameStore, RunDirectory, process
from dvax.app.runs.schema import SolverSection
from dvax.app.runs.solutions import all_finite
from dvax.app.runs.solver_options import in_keys_of, in_solver_keys
from dvax.errors import InputError, SolveError, input_error
from dvax.evolution import ETD1, ETD2RK, ETD4RK, DormandPrince, ExpRosenbrock, Solution, solve
from dvax.spaces import AbstractSpace
from dvax.theory import Bound, bound_error

_METHODS = {kind.__name__: kind for kind in (ETD1, ETD2RK, ETD4RK, ExpRosenbrock, DormandPrince)}

Listener = Callable[[dict[str, Any]], None]


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended. `exit_code`: 0 finished, 2 input that a solve refused, 3 failed, 130
    interrupted, 143 asked to terminate. `has_results`: whether any frame was written."""

    status: str
    exit_code: int
    stop_reason: str
    directory: Path
    summary: dict[str, Any]
    has_results: bool = True


def run(
    config: Config, out: Path, *, overwrite: bool = False, on_event: Listener | None = None
) -> RunOutcome:
    """Solve what `config` describes and leave a run directory at `out`.

    `on_event` is called with dicts whose "event" is compiling, compiled, progress, warning or
    stopped; of an application also stage.

    **Raises:** `dvax.InputError`, with nothing written, where `out` exists and is not empty and
    `overwrite` is false, or where data files no longer fit. A failure of the solve is not raised: it
    is the outcome, and what was computed before is on disk.
    """
    refuse_existing(out, overwrite)
    with terminable():
        inputs = interruptible(lambda: build_contact(config))
        tell = on_event or (lambda event: None)
        # Nothing lies in the folder before a manifest can say what it is.
        task = interruptible(lambda: _Run(config, inputs, tell))
        directory = RunDirectory(out, clear=True)
        try:
            return task.go(directory)
        finally:
            directory.close()


class _Run:
    """One run under way: the model, what is on disk, and how far it is."""

    directory: RunDirectory

    def __init__(self, config: Config, inputs: ContactInputs, tell: Listener):
        self.config, self.inputs, self.tell = config, inputs, tell
        self.compiling = compile_clock()
        self.model = contact_model(config, inputs)
        self.problem, self.constants = self.model.problem, self.model.constants
        self.space: AbstractSpace = self.problem.spaces(jnp.asarray(inputs.x0))[0]
        self.rows = constant_rows(self.constants, config, config.time.end, config.model.beta)
        self.started = datetime.now(UTC)
        self.clock = time.monotonic()
        self.steps = self.rejected = 0
        self.assumptions = assumptions(config, inputs)

    def go(self, directory: RunDirectory) -> RunOutcome:
        self.directory = directory
        write_resolved(self.config, self.inputs, self.directory.path)
        self._manifest("running", "The run is going on.")
        for notice in self.inputs.notices:
            self._event("warning", message=notice)
        times = self.inputs.frame_times
        block = block_length(len(times), self.inputs.boundary.size)
        store = FrameStore(
            self.directory.path / "trajectory.zarr",
            len(times),
            block,
            coordinates(self.inputs, self.config),
            variables(self.config, len(self.inputs.boundary.names), "estimated"),
            attributes(
                self.config,
                self.rows,
                self.inputs.boundary.shape,
                self.assumptions,
            ),
            {"long_name": "time", "units": self.config.units.time},
        )
        figures = Figures(self.inputs, self.config, self.constants)
        status, code, reason = "finished", 0, "The end time was reached."
        try:
            with (
                announced(lambda: self._event("compiling")),
                in_solver_keys(self.config.source.name),
            ):
                self._blocks(times, block, store, figures)
        except KeyboardInterrupt as stop:
            status, code = "interrupted", exit_code(stop)
            reason = "Interrupted; every frame written until then is kept."
        except InputError as error:
            status, code, reason = "failed", 2, str(error)
        except SolveError as error:
            told = error.told(in_keys_of(SolverSection, "solver", "time.end"))
            status, code, reason = "failed", 3, told
        except BaseException as error:
            # Whatever it was, the run is over, and its folder says so.
            with suppress(OSError):  # of a full disk, which is the error itself
                store.finish()
                self._manifest("failed", f"{type(error).__name__}: {error}", frames=store.written)
            raise
        with writing():
            store.finish()
            summary = {
                "status": {"value": status, "unit": "1", "meaning": reason},
                **figures.summary(self.steps),
            }
            self.directory.write_json("summary.json", summary)
            self._manifest(status, reason, frames=store.written)
            self._event("stopped", message=reason, status=status)
        return RunOutcome(status, code, reason, self.directory.path, summary, store.written > 0)

    def _blocks(
        self,
        times: np.ndarray,
        block: int,
        store: FrameStore,
        figures: Figures,
    ) -> None:
        main, other = _Piece(self.inputs.x0), _Piece(self.inputs.companion_x0)
        apart, error, defect = None, 0.0, 0.0
        for first in range(0, len(times), block):
            wanted = times[first : first + block]
            # Blocks are of one length, so that they share one compilation: the last repeats its end.
            ts = np.concatenate([wanted, np.full(block - len(wanted), wanted[-1])])
            start = times[max(first - 1, 0)]
            # Two trajectories keep two cores busy, once the first block has compiled for both.
            beside = self._beside(other, start, ts) if first else None
            failure = None
            try:
                a = self._solve(main, start, ts)
            except SolveError as stopped:
                a, failure, beside = stopped.solution, stopped, None
                if not isinstance(a, Solution) or len(a.ts) == 0 or float(a.ts[-1]) <= start:
                    raise
                ts = np.asarray(a.ts)
                wanted = wanted[: len(ts)]
            # The same arithmetic for both, so that their distance is not made of its differences.
            b = self._solve(other, start, ts) if beside is None else beside.result()
            bound, values = interruptible(self._values(a, b, error, apart))
            apart = float(values["separation_x"][0]) if apart is None else apart
            assert a.defect is not None
            values["defect"] = defect + np.asarray(a.defect)
            count = len(wanted)
            kept = {name: value[:count] for name, value in values.items()}
            figures.add(wanted, kept, bound.status)
            store.mark(("error_bound_x", "error_bound_u", "error_bound_sharp_x"), figures.status)
            store.write(wanted, kept)
            if failure is not None:
                raise failure
            main, other = self._end(a), self._end(b)
            error, defect = bound, values["defect"][-1]
            self.steps += int(a.stats["steps"])
            self.rejected += int(a.stats["rejected"])
            if first == 0:
                self._event("compiled", compile_seconds=self.compiling())
            self._event("progress", t=float(wanted[-1]), t_end=float(times[-1]), steps=self.steps)

    def _beside(self, piece: "_Piece", start: float, ts: np.ndarray) -> Work[Solution]:
        return Work(lambda: self._solve(piece, start, ts))

    def _values(
        self, a: Solution, b: Solution, error: Any, apart: Any
    ) -> Callable[[], tuple[Bound, dict[str, np.ndarray]]]:
        @np.errstate(over="ignore", invalid="ignore")  # a bound that overflows is infinite
        def compute() -> tuple[Bound, dict[str, np.ndarray]]:
            bound = bound_error(self.problem, a, self.constants, initial_error=error)
            return bound, block_values(self.model, self.space, a, b, bound, apart)

        return compute

    def _solve(self, piece: "_Piece", start: float, ts: np.ndarray) -> Solution:
        s = self.config.solver
        options: dict[str, Any] = (
            {} if s.vi_solver is None else {"vi_solver": getattr(vi, s.vi_solver)()}
        )
        solution = interruptible(
            lambda: solve(
                self.problem, jnp.asarray(piece.x), start, float(ts[-1]), None, ts,
                dt=s.dt, dt_max=s.dt_max, rtol=s.rtol or 1e-6, atol=s.atol or 1e-9,
                method=_METHODS[s.method](),
                constants=self.constants, measure=True, max_steps=s.max_steps,
                dt0=piece.dt, horizon=self.config.time.end, **options,
            )
        )  # fmt: skip
        return all_finite(solution, start)

    def _end(self, solved: Solution) -> "_Piece":
        fixed = self.config.solver.dt is not None
        return _Piece(solved.stats["x"], None if fixed else solved.stats["next_dt"])

    def _event(self, kind: str, **facts: Any) -> None:
        event = {"event": kind, **facts}
        self.directory.log(event)
        self.tell(event)

    def _manifest(self, status: str, reason: str, **more: Any) -> None:
        seconds = time.monotonic() - self.clock
        spent = self.compiling()
        files = {f.name: {"sha256": f.sha256, "bytes": f.bytes} for f in self.inputs.data_files}
        content = {
            **provenance(),
            **process(),
            "status": status,
            "stop_reason": reason,
            "started": self.started.isoformat(timespec="seconds"),
            "finished": None if status == "running" else _now(),
            "compile_seconds": round(spent, 3),
            "run_seconds": round(max(0.0, seconds - spent), 3),
            "steps": self.steps,
            "rejected_steps": self.rejected,
            "points": self.inputs.boundary.size,
            "data": files,
            "constants": self.rows,
            **more,
        }
        self.directory.write_json("manifest.json", content)


@dataclass(frozen=True)
class _Piece:
    """Where a trajectory stands: its state and the step it would take next."""

    x: Any
    dt: Any = None


def refuse_existing(out: Path, overwrite: bool) -> None:
    """Results are never written over others unasked."""
    if out.is_dir() and any(out.iterdir()) and not overwrite:
        raise input_error(
            str(out),
            "a folder that is not empty",
            "results are never written over others unasked",
            "Give another folder, or ask to overwrite this one",
        )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
