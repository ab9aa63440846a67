"""From a checked configuration of an application to its run directory."""

import shutil
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from dvax.errors import InputError, SolveError
from dvax.runs.applications.base import Results, Variable
from dvax.runs.applications.config import ModelConfig
from dvax.runs.applications.wording import in_keys
from dvax.runs.compile_time import announced, compile_clock
from dvax.runs.driver import Listener, RunOutcome, refuse_existing, terminable
from dvax.runs.provenance import provenance
from dvax.runs.resolved import DATA_FOLDER, NAME
from dvax.runs.rundir import RunDirectory
from dvax.theory import Assumption, Constants


def run_model(
    config: ModelConfig, out: Path, *, overwrite: bool = False, on_event: Listener | None = None
) -> RunOutcome:
    """Solve what `config` describes and leave a run directory at `out`; see `dvax.runs.driver.run`."""
    refuse_existing(out, overwrite)
    directory = RunDirectory(out, clear=True)
    try:
        return _Run(config, directory, on_event or (lambda event: None)).go()
    finally:
        directory.close()


class _Run:
    def __init__(self, config: ModelConfig, directory: RunDirectory, tell: Listener):
        self.config, self.directory, self.tell = config, directory, tell
        self.started, self.clock = datetime.now(UTC), time.monotonic()
        self.compiling = compile_clock()
        known = config.application.known(config.model)
        self.assumptions, self.notes = known.assumptions, known.notes
        self.rows = constant_rows(known.constants)
        self.steps = 0

    def go(self) -> RunOutcome:
        _write_resolved(self.config, self.directory.path)
        self._manifest("running", "The run is going on.")
        for note in self.notes:
            self._event("warning", message=note)
        results: Results | None = None
        status, code, reason = "finished", 0, "The model was solved to its end."
        try:
            application = self.config.application
            with (
                terminable(),
                announced(lambda: self._event("compiling")),
                in_keys(self.config.source.name, application),
            ):
                results = application.solve(self.config.model, self._stage)
            self._event("compiled", compile_seconds=self.compiling())
        except KeyboardInterrupt:
            status, code, reason = "interrupted", 130, "Interrupted before there were results."
        except InputError as error:
            status, code, reason = "failed", 2, str(error)
        except SolveError as error:
            status, code, reason = "failed", 3, str(error)
        except BaseException as error:
            # Whatever it was, the run is over, and its folder says so.
            self._manifest("failed", f"{type(error).__name__}: {error}")
            raise
        summary: dict[str, Any] = {}
        if results is not None:
            self._stage("writing the results")
            self._keep(results)
            summary = {
                name: {"value": _plain(f.value), "unit": f.unit, "meaning": f.meaning}
                for name, f in results.figures.items()
            }
        self.directory.write_json("summary.json", summary)
        self._manifest(status, reason)
        self._event("stopped", message=reason, status=status)
        return RunOutcome(status, code, reason, self.directory.path, summary)

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
            "model": self.config.name,
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
    rows = [{**row._asdict(), "unit": ""} for row in constants.table()]
    # JSON has no infinity, and a constant that is not finite says nothing.
    return [row for row in rows if np.isfinite(row["value"])]


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
            attributes={"long_name": v.words, "units": v.unit},
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
