"""From a checked configuration of an application to its run directory."""

import shutil
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from dvax.app.runs.applications.base import Plan, Results, Variable
from dvax.app.runs.applications.config import ModelConfig
from dvax.app.runs.applications.segments import joined, segments, states_alone
from dvax.app.runs.applications.wording import in_keys
from dvax.app.runs.compile_time import announced, compile_clock
from dvax.app.runs.driver import Listener, RunOutcome, refuse_existing
from dvax.app.runs.interrupt import Work, exit_code, interruptible, patience, terminable, writing
from dvax.app.runs.json_numbers import bound_meaning
from dvax.app.runs.provenance import provenance
from dvax.app.runs.resolved import DATA_FOLDER, NAME
from dvax.app.runs.rundir import RunDirectory, process
from dvax.app.runs.solver_options import in_keys_of
from dvax.errors import InputError, SolveError
from dvax.evolution import Solution
from dvax.theory import Assumption, Constants


def run_model(
    config: ModelConfig, out: Path, *, overwrite: bool = False, on_event: Listener | None = None
) -> RunOutcome:
    """Solve what `config` describes and leave a run directory at `out`, as `driver.run` does."""
    refuse_existing(out, overwrite)
    with terminable():
        tell = on_event or (lambda event: None)
        # Nothing lies in the folder before a manifest can say what it is.
        task = interruptible(lambda: _Run(config, tell))
        directory = RunDirectory(out, clear=True)
        try:
            return task.go(directory)
        finally:
            directory.close()


class _Run:
    directory: RunDirectory

    def __init__(self, config: ModelConfig, tell: Listener):
        self.config, self.tell = config, tell
        self.started, self.clock = datetime.now(UTC), time.monotonic()
        self.compiling = compile_clock()
        known = config.application.known(config.model)
        self.assumptions, self.notes = known.assumptions, known.notes
        self.rows = constant_rows(known.constants)
        self.steps = 0

    def go(self, directory: RunDirectory) -> RunOutcome:
        self.directory = directory
        _write_resolved(self.config, self.directory.path)
        self._manifest("running", "The run is going on.")
        for note in self.notes:
            self._event("warning", message=note)
        status, code, reason = "finished", 0, "The model was solved to its end."
        plan: Plan | None = None
        pieces: list[Solution] = []
        results: Results | None = None
        last: Work[Results] | None = None
        try:
            with (
                announced(lambda: self._event("compiling")),
                in_keys(self.config.source.name, self.config.application),
            ):
                plan = interruptible(
                    lambda: self.config.application.plan(self.config.model, self._stage)
                )
                for piece in segments(plan):
                    pieces.append(piece)
                    if len(pieces) == 1:
                        # All that the figures need is compiled now, so that whoever ends the run
                        # later on has them at once.
                        last = Work(self._results(plan, pieces))
                        last.result()
                        last = None
                        self._event("compiled", compile_seconds=self.compiling())
                    self._progress(plan, piece)
                self._stage("writing the results")
                last = Work(self._results(plan, pieces))
                results = last.result()
        except KeyboardInterrupt as stop:
            status, code = "interrupted", exit_code(stop)
            reason = f"Interrupted {self._reached(plan, pieces)}."
        except InputError as error:
            status, code, reason = "failed", 2, str(error)
        except SolveError as error:
            section, end = self.config.application.section, self.config.application.end
            status, code = "failed", 3
            reason = error.told(in_keys_of(section, "model", end))
        except BaseException as error:
            # Whatever it was, the run is over, and its folder says so.
            self._manifest("failed", f"{type(error).__name__}: {error}")
            raise
        if results is None and plan is not None and pieces:
            try:
                results = (last or Work(self._results(plan, pieces))).result(patience())
            except (KeyboardInterrupt, TimeoutError):
                results = states_alone(pieces)
                reason += " Its states alone were kept: there was no time for figures."
        with writing():
            if results is not None:
                self._keep(results)
            summary = self._summary(status, reason, results)
            self.directory.write_json("summary.json", summary)
            self._manifest(status, reason)
            self._event("stopped", message=reason, status=status)
        return RunOutcome(status, code, reason, self.directory.path, summary, results is not None)

    def _results(self, plan: Plan, pieces: list[Solution]) -> Callable[[], Results]:
        """Work that returns what the pieces give."""
        config, given = self.config, list(pieces)

        def compute() -> Results:
            every = len(plan.times)
            count = sum(len(piece.ts) for piece in given) if given else every
            solution = joined(given, every) if given else None
            return config.application.results(config.model, plan, solution, count)

        return compute

    def _progress(self, plan: Plan, piece: Solution) -> None:
        self.steps += int(piece.stats["steps"])
        begin, t = float(plan.times[0]), float(piece.ts[-1])
        self._event(
            "progress", t=t - begin, t_end=float(plan.times[-1]) - begin, steps=self.steps,
            unit=plan.time_unit,
        )  # fmt: skip

    @staticmethod
    def _reached(plan: Plan | None, pieces: list[Solution]) -> str:
        if plan is None or not pieces:
            return "before there were results"
        unit, end = f" {plan.time_unit}".rstrip(), float(plan.times[-1])
        return f"at t = {float(pieces[-1].ts[-1]):.10g} of {end:.10g}{unit}; what was saved is kept"

    @staticmethod
    def _summary(status: str, reason: str, results: Results | None) -> dict[str, Any]:
        """The figures, and before them how the run ended."""
        summary: dict[str, Any] = {"status": {"value": status, "unit": "1", "meaning": reason}}
        for name, f in (results.figures if results is not None else {}).items():
            summary[name] = {"value": _plain(f.value), "unit": f.unit, "meaning": f.meaning}
            if f.error is not None:
                summary[name]["error"] = _plain(f.error)
            if f.bound is not None:
                summary[name]["bound"] = f.bound
                summary[name]["meaning"] = bound_meaning(f.meaning, summary[name]["value"])
        return summary

    def _keep(self, results: Results) -> None:
        """What was found, on disk."""
        self.steps = results.steps
        if results.constants is not None:
            self.rows = constant_rows(results.constants)
        self.assumptions = results.assumptions or self.assumptions
        for notice in results.notices:
            self._event("warning", message=notice)
        attrs = {
            "title": f"{self.config.name}, {self.config.source.stem}",
            "model": self.config.name,
        }
        write_dataset(self.directory.path / "trajectory.zarr", results.variables, attrs)
        if results.files is not None:
            results.files(self.directory.path)

    def _stage(self, words: str) -> None:
        self._event("stage", stage=words)

    def _event(self, kind: str, **facts: Any) -> None:
        event = {"event": kind, **facts}
        self.directory.log(event)
        self.tell(event)

    def _manifest(self, status: str, reason: str) -> None:
        seconds, spent = time.monotonic() - self.clock, self.compiling()
        now = datetime.now(UTC).isoformat(timespec="seconds")
        content = {
            **provenance(),
            **process(),
            "model": self.config.name,
            "title": f"{self.config.name}, {self.config.source.stem}",
            "fit": self.config.application.fit(self.config.model),
            "status": status,
            "stop_reason": reason,
            "started": self.started.isoformat(timespec="seconds"),
            "finished": None if status == "running" else now,
            "compile_seconds": round(spent, 3),
            "run_seconds": round(max(0.0, seconds - spent), 3),
            "steps": self.steps,
            "data": {
                f.name: {"sha256": f.sha256, "bytes": f.bytes} for f in self.config.fingerprints()
            },
            "constants": self.rows,
            "assumptions": assumption_rows(self.assumptions),
        }
        self.directory.write_json("manifest.json", content)


def constant_rows(constants: Constants | None) -> list[dict[str, Any]]:
    """The table of constants; an application's units are those of its own description."""
    if constants is None:
        return []
    return [{**row._asdict(), "unit": ""} for row in constants.table()]


def assumption_rows(known: tuple[Assumption, ...]) -> list[dict[str, str]]:
    """The assumptions as the report shows them."""
    return [
        {"label": a.label, "statement": a.statement, "status": a.status, "why": a.why}
        for a in known
    ]


def write_dataset(path: Path, variables: Mapping[str, Variable], attrs: Mapping[str, Any]) -> None:
    """A zarr group that xarray opens as a Dataset."""
    coordinates = [name for name, v in variables.items() if v.dims == (name,)]
    group = zarr.open_group(
        path, mode="w-", zarr_format=3,
        attributes={**attrs, "coordinates": " ".join(coordinates)},
    )  # fmt: skip
    for name, v in variables.items():
        values = np.asarray(v.values)
        group.create_array(
            name, data=values, dimension_names=v.dims,
            attributes={
                "long_name": v.words, "units": v.unit, **({"status": v.status} if v.status else {}),
            },
        )  # fmt: skip


def _write_resolved(config: ModelConfig, directory: Path) -> None:
    """The complete configuration and copies of its data: it gives the same run wherever it is moved."""
    names: dict[str, str] = {}
    for key, source in config.data_files():
        of_folder = key in config.application.folders
        folder = Path(DATA_FOLDER) / key if of_folder else Path(DATA_FOLDER)
        inside = source.relative_to(config.paths[key]) if of_folder else f"{key}_{source.name}"
        target = folder / inside
        names[key] = str(folder if of_folder else target)
        (directory / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, directory / target)
    (directory / NAME).write_text(config.to_toml(names), encoding="utf-8")


def _plain(value: Any) -> Any:
    """A number or list as JSON has it."""
    array = np.asarray(value)
    return array.tolist() if array.ndim or isinstance(value, np.generic | np.ndarray) else value
