"""One run: from a checked configuration to a run directory that is readable whatever ends the run."""

import abc
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dvax.app.runs.checkpoints import Checkpoint, Checkpoints
from dvax.app.runs.compile_time import compile_stopwatch
from dvax.app.runs.data_file import DataFile, fingerprint
from dvax.app.runs.figure import Figure
from dvax.app.runs.interrupt import exit_code, writing
from dvax.app.runs.keys import flat_keys
from dvax.app.runs.provenance import provenance
from dvax.app.runs.resolved import write_resolved
from dvax.app.runs.rundir import RunDirectory, process
from dvax.app.runs.wording import Wording
from dvax.errors import InputError, SolveError
from dvax.theory import Assumption

if TYPE_CHECKING:
    from dvax.app.runs.applications.config import ModelConfig
    from dvax.app.runs.settings import Config

Listener = Callable[[dict[str, Any]], None]


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended. `exit_code`: 0 finished, 2 input that a solve refused, 3 failed, 130
    interrupted, 143 asked to terminate. `has_results`: whether any result was written."""

    status: str
    exit_code: int
    stop_reason: str
    directory: Path
    summary: dict[str, Any]
    has_results: bool


@dataclass(frozen=True)
class Facts:
    """What a manifest says of a run: the constants as `rows`, the assumptions, the data that were read,
    and facts of its model; `notices` are sentences for the log."""

    rows: Sequence[Mapping[str, Any]]
    assumptions: tuple[Assumption, ...]
    data: Sequence[DataFile]
    notices: Sequence[str]
    model: Mapping[str, Any]


class AbstractRun(abc.ABC):
    """A run under way. `facts` stand in the manifest, `wording` turns errors into the words of the
    configuration file; whoever takes steps counts them, and names the method."""

    facts: Facts
    wording: Wording
    directory: RunDirectory

    def __init__(self, config: "Config | ModelConfig", tell: Listener):
        self.config, self.tell = config, tell
        self.compiling = compile_stopwatch()
        self.started, self.clock = datetime.now(UTC), time.monotonic()
        self.steps = self.rejected = 0
        self.method = ""

    @abc.abstractmethod
    def begin(self) -> None:
        """Prepare the results in the run directory, which is there by now, and take up the saved
        `checkpoints` of a run that goes on."""

    @abc.abstractmethod
    def checkpoint(self) -> None:
        """Save what `solve` has reached, if that is not saved yet."""

    @abc.abstractmethod
    def solve(self) -> None:
        """Solve all of it. **Raises:** what ends a run early."""

    @abc.abstractmethod
    def reached(self) -> str:
        """How far the run came, and what is kept: what follows the word "Interrupted"."""

    @abc.abstractmethod
    def gather(self) -> str:
        """Prepare the results that there are once `solve` has ended, and return a sentence on what is
        lost, or nothing."""

    @abc.abstractmethod
    def write(self) -> tuple[Mapping[str, Figure], bool]:
        """Complete the results on disk.

        **Returns:** the figures for summary.json, and whether there are any results.
        """

    def go(self, directory: RunDirectory, *, resume: bool = False) -> RunOutcome:
        """Solve, and leave the results, the summary and the manifest in `directory`; with `resume` go
        on from the checkpoints there.

        **Raises:** `dvax.InputError` if they are of another configuration, other data or versions.
        """
        self.directory = directory
        seconds = self.config.output.checkpoint_seconds
        self.checkpoints = Checkpoints(directory.path, self._identity(), seconds)
        self.saved: list[Checkpoint] = []
        if resume:
            self.saved, damaged = self.checkpoints.load()
            # The name of the first configuration, and not that of the resolved one.
            title = {"title": directory.title()} if directory.title() else {}
            self.facts = replace(self.facts, model={**self.facts.model, **title})
            if directory.lost:
                words = f"log.jsonl was damaged: {directory.lost} of its lines are removed."
                self.event("warning", message=words)
            for file in damaged:
                self.event("warning", message=f"{file} is damaged: it is not used.")
        else:
            write_resolved(self.config, directory.path)
        self._write_manifest("running", "The run is in progress.")
        for notice in self.facts.notices:
            self.event("warning", message=notice)
        self.begin()
        status, code, reason = "finished", 0, "The run reached its end."
        try:
            with self.wording.in_keys():
                self.solve()
        except KeyboardInterrupt as stop:
            status, code = "interrupted", exit_code(stop)
            reason = f"Interrupted{self.reached()}."
        except InputError as error:
            status, code, reason = "failed", 2, str(error)
        except SolveError as error:
            status, code, reason = "failed", 3, error.message(self.wording.fix)
        except BaseException as error:
            # The run has ended, and its manifest says so.
            with suppress(OSError):  # a full disk may be the error itself
                self.write()
                self._write_manifest("failed", f"{type(error).__name__}: {error}")
            raise
        if status != "finished":
            with writing():
                self.try_checkpoint()
        missing = self.gather()
        reason = f"{reason.removesuffix('.')}. {missing}" if missing else reason
        with writing():
            figures, has_results = self.write()
            figures = {"status": Figure(status, "1", reason), **figures}
            summary = {name: figure.to_json() for name, figure in figures.items()}
            directory.write_json("summary.json", summary)
            self._write_manifest(status, reason)
            self.event("stopped", message=reason, status=status)
            if status == "finished":
                self.checkpoints.clear()
        return RunOutcome(status, code, reason, directory.path, summary, has_results)

    def _identity(self) -> dict[str, str]:
        """Return what must be the same for a run to go on: the settings but those of the output, the
        data and the versions."""
        files = self.config.data_files()
        keys = {key for key, _ in files}
        # Copies have other names than the files that they were made from.
        data = {
            f"data of {key}, {k}": fingerprint(key, path).sha256
            for k, (key, path) in enumerate(files)
        }
        settings = {
            key: repr(value)
            for key, value in flat_keys(self.config.tree()).items()
            if key not in keys and not key.startswith("output.")
        }
        made_by = provenance()
        packages = {name: str(made_by["packages"][name]) for name in ("jax", "jaxlib", "numpy")}
        return {
            **settings,
            **data,
            **{name: str(made_by[name]) for name in ("dvax", "device", "precision")},
            **packages,
        }

    def try_checkpoint(self) -> None:
        """Save a checkpoint, or warn: a run does not fail because of it."""
        try:
            self.checkpoint()
        except OSError as error:
            with suppress(OSError):  # the log may lie on the same full disk
                self.event("warning", message=f"No checkpoint could be written: {error}")

    def tell_resumed(self, t: float, unit: str) -> None:
        """Tell that the run goes on from this time."""
        self.event("stage", stage=f"going on from t = {t:.10g} {unit}".rstrip())

    def event(self, kind: str, **facts: Any) -> None:
        """Log an event and tell the listener."""
        event = {"event": kind, **facts}
        self.directory.log(event)
        self.tell(event)

    def _write_manifest(self, status: str, reason: str) -> None:
        seconds, compiling = time.monotonic() - self.clock, self.compiling()
        now = datetime.now(UTC)
        content = {
            **provenance(),
            **process(),
            **self.facts.model,
            "status": status,
            "stop_reason": reason,
            "started": self.started.isoformat(timespec="seconds"),
            "finished": None if status == "running" else now.isoformat(timespec="seconds"),
            "compile_seconds": round(compiling, 3),
            "run_seconds": round(max(0.0, seconds - compiling), 3),
            "method": self.method,
            "steps": self.steps,
            "rejected_steps": self.rejected,
            "data": {f.name: {"sha256": f.sha256, "bytes": f.bytes} for f in self.facts.data},
            "constants": self.facts.rows,
            "assumptions": assumption_rows(self.facts.assumptions),
        }
        self.directory.write_json("manifest.json", content)


def assumption_rows(assumptions: Sequence[Assumption]) -> list[dict[str, Any]]:
    """The assumptions as manifest and report show them."""
    names = ("label", "statement", "status", "why", "is_required")
    return [{name: getattr(row, name) for name in names} for row in assumptions]
