"""Read a run directory: the manifest, the summary, the constants, and the trajectory lazily.

Only the small files and the time axis are loaded here; the fields of a trajectory are read when a
picture needs them, block by block (see `downsample.py`)."""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dvax._files import time_axis
from dvax.app.plots.store import Store, Variable, open_store
from dvax.errors import InputError, input_error

CONTACT = "contact"
"""The model of a manifest that names none."""

_RESUMED = "going on from "
"""Before the time from which a run is resumed, in its log."""

# The status of a run in manifest.json that did not reach its end, and what it means.
UNFINISHED = {
    "running": "The run had not ended when this report was made: it is going on, or was killed.",
    "killed": "The run was killed before its end.",
    "interrupted": "The run was interrupted before its end.",
    "failed": "The run failed before its end.",
}


@dataclass(frozen=True)
class ConstantRow:
    """One constant of the theory: its value, its formula's label in the paper, what it rests on.

    `status` is proved, declared, estimated or refuted; `meaning` is one sentence.
    """

    name: str
    symbol: str
    value: Any
    unit: str
    label: str
    status: str
    meaning: str


@dataclass(frozen=True)
class AssumptionRow:
    """One assumption of the theory: its label, what it says, its status, and how that is known."""

    label: str
    statement: str
    status: str
    why: str
    is_required: bool = True


Row = TypeVar("Row", ConstantRow, AssumptionRow)


@dataclass(frozen=True)
class RunRecord:
    """The content of a run directory. `trajectory` is None where no results were written."""

    directory: Path
    manifest: Mapping[str, Any]
    summary: Mapping[str, Mapping[str, Any]]
    config: Mapping[str, Any]
    constants: tuple[ConstantRow, ...]
    warnings: tuple[str, ...]
    trajectory: Store | None
    assumptions: tuple[AssumptionRow, ...] = field(default=())
    notes: tuple[str, ...] = field(default=())
    resumed: tuple[str, ...] = field(default=())
    """The times from which the run went on, such as "t = 2 s"."""

    @property
    def model(self) -> str:
        """The name of the model."""
        return str(self.manifest.get("model", CONTACT))

    @property
    def title(self) -> str:
        """The run's name: the dataset's, else the directory's."""
        named = "" if self.trajectory is None else str(self.trajectory.attrs.get("title", ""))
        return named or str(self.manifest.get("title") or self.directory.resolve().name)

    @property
    def status(self) -> str:
        """The manifest's word: finished, running, interrupted or failed."""
        return str(self.manifest.get("status", "unknown"))

    @property
    def attrs(self) -> Mapping[str, Any]:
        """The attributes of the dataset."""
        return {} if self.trajectory is None else self.trajectory.attrs

    @property
    def time(self) -> np.ndarray:
        """Saved times, shape (frames,), in the run's unit of time."""
        return self.series("time")

    @property
    def saved_times(self) -> Variable | None:
        """The saved times of any model, with their unit; None where there are none."""
        if self.trajectory is None:
            return None
        return self.trajectory.variables.get(time_axis(self.trajectory.attrs))

    @property
    def boundary_shape(self) -> tuple[int, ...]:
        """(n,) on a curve, (n1, n2) on a surface whose points are flattened in C order."""
        given = self.attrs.get("boundary_shape")
        if given is None or len(given) == 1:
            return (self["pressure"].points,)
        return tuple(int(n) for n in given)

    def __getitem__(self, name: str) -> Variable:
        """A variable of the trajectory."""
        if self.trajectory is None:
            raise KeyError(f"{self.directory} holds no trajectory")
        return self.trajectory.variables[name]

    @property
    def config_text(self) -> str:
        """The text of config.resolved.toml; empty where there is none."""
        file = self.directory / "config.resolved.toml"
        return file.read_text(encoding="utf-8") if file.is_file() else ""

    def has(self, name: str) -> bool:
        """Whether the trajectory holds the variable `name`."""
        return self.trajectory is not None and name in self.trajectory.variables

    def series(self, name: str) -> np.ndarray:
        """A variable over time alone or over points alone, in double precision."""
        return self[name].values.astype(float)

    def unit(self, name: str) -> str:
        """The unit of a variable or coordinate, as the trajectory declares it."""
        return self[name].unit


def read_run(directory: Path) -> RunRecord:
    """Read the run directory `directory`. InputError where it is not one or a file is damaged."""
    if not (directory / "manifest.json").is_file():
        raise input_error(
            str(directory),
            _other_than_a_run(directory),
            "a run directory holds manifest.json and trajectory.zarr",
            "Give the folder that `dvax run ... -o FOLDER` wrote.",
        )
    manifest = _json(directory / "manifest.json")
    summary_file = directory / "summary.json"
    config_file = directory / "config.resolved.toml"
    trajectory, notes = _trajectory(
        directory / "trajectory.zarr", needs_time=manifest.get("model", CONTACT) == CONTACT
    )
    events = _events(directory / "log.jsonl")
    return RunRecord(
        directory=directory,
        manifest=manifest,
        summary=_json(summary_file) if summary_file.is_file() else {},
        config=_toml(config_file) if config_file.is_file() else {},
        constants=_rows(ConstantRow, manifest.get("constants")),
        warnings=_messages(events, "warning", "message"),
        trajectory=trajectory,
        assumptions=_rows(AssumptionRow, manifest.get("assumptions")),
        notes=notes,
        resumed=tuple(
            stage.removeprefix(_RESUMED)
            for stage in _messages(events, "stage", "stage")
            if stage.startswith(_RESUMED)
        ),
    )


def _other_than_a_run(path: Path) -> str:
    """Describe a path that is no run directory."""
    if path.is_dir():
        return "a folder without manifest.json"
    return "a file, not a folder" if path.exists() else "no such folder"


def _damaged(file: Path, error: Exception) -> InputError:
    return input_error(
        str(file),
        f"text that does not parse ({error})",
        "a run directory's files are written by dvax and must be whole to be read",
        "Restore the file from a copy, or run again.",
    )


def _json(file: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise _damaged(file, error) from error
    if not isinstance(content, dict):
        raise _damaged(file, ValueError(f"a {type(content).__name__}, not an object"))
    return content


def _toml(file: Path) -> Mapping[str, Any]:
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise _damaged(file, error) from error


def _trajectory(path: Path, needs_time: bool) -> tuple[Store | None, tuple[str, ...]]:
    """The results that are whole, and a note where some frames were left out."""
    if not path.exists():
        return None, ()
    try:
        store, room = open_store(path)
    except (OSError, ValueError, KeyError) as error:
        raise _damaged(path, error) from error
    whole = store.count or 0
    notes = ()
    if whole < room:
        notes = (
            f"{room - whole} of {room} frames have no valid time: "
            "the run ended before they were complete. They are left out.",
        )
    return (store if whole or not needs_time else None), notes


def _rows(kind: type[Row], rows: Any) -> tuple[Row, ...]:
    """A list of the manifest as rows of one kind."""
    names = tuple(kind.__dataclass_fields__)
    given = rows if isinstance(rows, list) else []
    missing = dict.fromkeys(names, "") | {"is_required": True}
    return tuple(kind(**{name: row.get(name, missing[name]) for name in names}) for row in given)


def _messages(events: list[Mapping[str, Any]], kind: str, key: str) -> tuple[str, ...]:
    """What the events of a kind say under `key`, in order, each once."""
    return tuple(dict.fromkeys(str(e.get(key, "")) for e in events if e.get("event") == kind))


def _events(log: Path) -> list[Mapping[str, Any]]:
    """The events of the log, in order. A last line cut off by a kill is not read."""
    if not log.is_file():
        return []
    found: list[Mapping[str, Any]] = []
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    for number, line in enumerate(lines):
        try:
            event = json.loads(line)
        except json.JSONDecodeError as error:
            if number == len(lines) - 1:
                break
            raise _damaged(log, error) from error
        if isinstance(event, dict):
            found.append(event)
    return found
