"""A run of the contact law, block by block of saved frames.

The trajectory is never held as a whole: each block of frames is solved, certified, written and freed.
A block starts from the last state and step size of the one before, so results do not depend on the
blocks, and the store is readable whenever and however the run ends.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from dvax.app.runs.blocks import block_length
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
from dvax.app.runs.rundir import FrameStore
from dvax.app.runs.schema import SolverSection
from dvax.app.runs.solutions import all_finite
from dvax.app.runs.solver_options import settings
from dvax.app.runs.wording import Wording
from dvax.errors import SolveError
from dvax.evolution import Solution, solve
from dvax.spaces import AbstractSpace
from dvax.theory import Bound, bound_error

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
            {"points": inputs.boundary.size},
        )
        file = config.source.name
        self.wording = Wording(file, "solver", SolverSection, elsewhere=_ELSEWHERE)
        self.block = block_length(len(inputs.frame_times), inputs.boundary.size)
        self.figures = Figures(inputs, config, self.constants)

    def begin(self) -> None:
        inputs, config = self.inputs, self.config
        self.store = FrameStore(
            self.directory.path / "trajectory.zarr",
            len(inputs.frame_times),
            self.block,
            coordinates(inputs, config),
            variables(config, len(inputs.boundary.names)),
            attributes(config, self.facts.rows, inputs.boundary.shape, self.facts.assumptions),
            {"long_name": "time", "units": config.units.time},
        )

    def solve(self) -> None:
        times = self.inputs.frame_times
        main, other = _Piece(self.inputs.x0), _Piece(self.inputs.companion_x0)
        apart, error, defect = None, 0.0, 0.0
        for first in range(0, len(times), self.block):
            wanted = times[first : first + self.block]
            # Blocks have one length, so that they share one compiled program: the last repeats its end.
            ts = np.concatenate([wanted, np.full(self.block - len(wanted), wanted[-1])])
            start = times[max(first - 1, 0)]
            # After the first block, which compiles, the two trajectories run on two cores.
            beside = self._solve_beside(other, start, ts) if first else None
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
            if first == 0:
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
