"""A run of the contact law, block by block of saved frames.

The trajectory is never held as a whole: each block of frames is solved, certified, written and freed.
A block starts from the last state and step size of the one before, so results do not depend on the
blocks, and the store is readable whenever and however the run ends.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dvax.app.runs.blocks import block_length
from dvax.app.runs.checkpoints import Checkpoint
from dvax.app.runs.config import Config, build_contact
from dvax.app.runs.contact_figures import Figures
from dvax.app.runs.contact_frames import (
    attributes,
    block_values,
    constant_rows,
    coordinates,
    variables,
)
from dvax.app.runs.contact_model import assumptions, contact_model
from dvax.app.runs.figure import Figure
from dvax.app.runs.interrupt import Work, interruptible
from dvax.app.runs.run import AbstractRun, Facts, Listener
from dvax.app.runs.rundir import FrameStore, damaged_files, new_store, recover_store
from dvax.app.runs.schema import SolverSection
from dvax.app.runs.solver_options import settings
from dvax.app.runs.wording import Wording
from dvax.errors import SolveError
from dvax.evolution import Solution, solve
from dvax.evolution.rows import all_finite
from dvax.spaces import AbstractSpace
from dvax.theory import Bound, Status, bound_error

_ELSEWHERE = {"t0": "time", "t1": "time.end", "ts": "time.frames", "x0": "initial"}
_BOUNDS = ("error_bound_x", "error_bound_u", "error_bound_sharp_x")


class ContactRun(AbstractRun):
    """The model, its frames on disk, and the figures so far."""

    config: Config

    def __init__(self, config: Config, tell: Listener):
        super().__init__(config, tell)
        self.inputs = inputs = build_contact(config)
        self.model = contact_model(config, inputs)
        self.problem, self.constants = self.model.problem, self.model.constants
        self.space: AbstractSpace = self.problem.spaces(jnp.asarray(inputs.x0))[0]
        self.facts = Facts(
            constant_rows(self.constants, config, config.time.end, config.model.beta),
            assumptions(config, inputs),
            inputs.data_files,
            inputs.notices,
            {"points": inputs.boundary.size, "title": f"contact law, {config.source.stem}"},
        )
        file = config.source.name
        self.wording = Wording(file, "solver", SolverSection, elsewhere=_ELSEWHERE)
        self.block = block_length(len(inputs.frame_times), inputs.boundary.size)
        self.figures = Figures(inputs, config, self.constants)

    def begin(self) -> None:
        inputs, config = self.inputs, self.config
        self.at = self.kept = _Reached(_Piece(inputs.x0), _Piece(inputs.companion_x0))
        path = self.directory.path / "trajectory.zarr"
        recover_store(path)
        for saved in reversed(self.saved):
            reached = _Reached.of(saved)
            damaged = damaged_files(path, reached.files)
            if damaged is None:
                self.at = self.kept = reached
                break
            self.event("warning", message=f"{damaged} is damaged: it is not used.")
        self.store = FrameStore(
            new_store(path),
            len(inputs.frame_times),
            self.block,
            coordinates(inputs, config),
            variables(config, len(inputs.boundary.names)),
            attributes(
                config, self.facts.model["title"], self.facts.rows, inputs.boundary.shape,
                self.facts.assumptions,
            ),
            {"long_name": "time", "units": config.units.time},
        )  # fmt: skip
        self.store.copy_frames(path, self.at.frames, self.at.files)
        self.store.move(path)
        if self.at.frames == 0:
            return
        self.steps, self.rejected, self.method = self.at.steps, self.at.rejected, self.at.method
        self.tell_resumed(float(inputs.frame_times[self.at.frames - 1]), config.units.time)
        for first in range(0, self.at.frames, self.block):
            frames = slice(first, first + self.block)
            self.figures.add(inputs.frame_times[frames], self.store.read(frames), self.at.status)
        self.store.mark(_BOUNDS, self.figures.status)

    def checkpoint(self) -> None:
        if self.at.frames == self.kept.frames:
            return
        arrays, about = self.at.to_checkpoint()
        about["files"] = self.store.files(self.at.frames)
        self.checkpoints.save(self.at.frames, arrays, about)
        self.checkpoints.keep(2)
        self.kept = self.at

    def solve(self) -> None:
        times, at = self.inputs.frame_times, self.at
        main, other = at.main, at.other
        apart, error, defect = at.apart, at.error, at.defect
        for first in range(at.frames, len(times), self.block):
            wanted = times[first : first + self.block]
            # Blocks have one length, so that they share one compiled program: the last repeats its end.
            ts = np.concatenate([wanted, np.full(self.block - len(wanted), wanted[-1])])
            start = times[max(first - 1, 0)]
            # After the first block, which compiles, the two trajectories run on two cores.
            beside = self._solve_beside(other, start, ts) if first > at.frames else None
            failure = None
            try:
                a = self._solve(main, start, ts)
            except SolveError as stopped:
                a, failure, beside = stopped.solution, stopped, None
                if not isinstance(a, Solution) or len(a.ts) == 0 or float(a.ts[-1]) <= start:
                    raise
                ts = np.asarray(a.ts)
                wanted = wanted[: len(ts)]
            # The same program for both, so that their distance is not one of arithmetic.
            b = self._solve(other, start, ts) if beside is None else beside.result()
            bound, values = interruptible(self._values(a, b, error, apart))
            apart = float(values["separation_x"][0]) if apart is None else apart
            assert a.defect is not None
            values["defect"] = defect + np.asarray(a.defect)
            kept = {name: value[: len(wanted)] for name, value in values.items()}
            self.figures.add(wanted, kept, bound.status)
            self.store.mark(_BOUNDS, self.figures.status)
            self.store.write(wanted, kept)
            if failure is not None:
                raise failure
            main, other = self._end(a), self._end(b)
            error, defect = bound, values["defect"][-1]
            self.steps += int(a.stats["steps"])
            self.method = str(a.stats["method"])
            self.rejected += int(a.stats["rejected"])
            self.at = _Reached(
                main, other, apart, error, defect, self.store.written, self.steps, self.rejected,
                self.method, self.figures.status,
            )  # fmt: skip
            if self.checkpoints.is_due():
                self.try_checkpoint()
            if first == at.frames:
                self.event("compiled", compile_seconds=self.compiling())
            self.event(
                "progress",
                t=float(wanted[-1]),
                t_end=float(times[-1]),
                steps=self.steps,
                method=self.method,
                unit=self.config.units.time,
            )

    def reached(self) -> str:
        return "; every frame written until then is kept"

    def gather(self) -> str:
        return ""

    def write(self) -> tuple[dict[str, Figure], bool]:
        self.store.finish()
        about = {**self.facts.model, "frames": self.store.written}
        self.facts = replace(self.facts, model=about)
        return self.figures.summary(self.steps), self.store.written > 0

    def _solve_beside(self, piece: "_Piece", start: float, ts: np.ndarray) -> Work[Solution]:
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
        solution = interruptible(
            lambda: solve(
                self.problem, jnp.asarray(piece.x), start, float(ts[-1]), None, ts,
                constants=self.constants, measure=True, dt0=piece.dt,
                horizon=self.config.time.end, **settings(self.config.solver),
            )
        )  # fmt: skip
        return all_finite(solution, start)

    def _end(self, solved: Solution) -> "_Piece":
        fixed = self.config.solver.dt is not None
        return _Piece(solved.stats["x"], None if fixed else solved.stats["next_dt"])


@dataclass(frozen=True)
class _Piece:
    """The end of a piece of a trajectory: its state and the next step size."""

    x: Any
    dt: Any = None


@dataclass(frozen=True)
class _Reached:
    """What the next block starts from: the ends of both trajectories, their first distance, the error
    bound and the integrated defect so far, and counts."""

    main: _Piece
    other: _Piece
    apart: float | None = None
    error: Any = 0.0
    defect: Any = 0.0
    frames: int = 0
    steps: int = 0
    rejected: int = 0
    method: str = ""
    status: Status = "proved"
    files: Mapping[str, str] = field(default_factory=dict)
    """The hashes of the files of these frames."""

    def to_checkpoint(self) -> tuple[list[Any], dict[str, Any]]:
        """Return arrays and facts; of the bound its last row."""
        assert isinstance(self.error, Bound)
        bound = {f.name: getattr(self.error, f.name) for f in fields(self.error)}
        bound["last"] = None  # it is the state of the run
        rows = {name: v for name, v in bound.items() if isinstance(v, jax.Array | np.ndarray)}
        main, other = self.main, self.other
        arrays = [main.x, other.x, self.defect, *(np.asarray(v)[-1:] for v in rows.values())]
        about = {
            "dt": [None if p.dt is None else float(p.dt) for p in (main, other)],
            "apart": self.apart, "bound": list(rows), "bound_status": self.error.status,
            "why": self.error.why,
            "frames": self.frames, "steps": self.steps, "rejected": self.rejected,
            "method": self.method, "status": self.status,
        }  # fmt: skip
        return arrays, about

    @staticmethod
    def of(saved: Checkpoint) -> "_Reached":
        about = saved.about
        main, other, defect, *rows = saved.arrays
        bound: dict[str, Any] = dict.fromkeys((f.name for f in fields(Bound)), None)
        bound |= zip(about["bound"], map(jnp.asarray, rows), strict=True)
        bound |= {"status": about["bound_status"], "why": about.get("why", ""), "last": main}
        return _Reached(
            _Piece(main, about["dt"][0]), _Piece(other, about["dt"][1]), float(about["apart"]),
            Bound(**bound), defect[()],
            about["frames"], about["steps"], about["rejected"], about["method"], about["status"],
            about["files"],
        )  # fmt: skip
