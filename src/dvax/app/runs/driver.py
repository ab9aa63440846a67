"""`run`: from a checked configuration of any model to a run directory."""

from pathlib import Path

from dvax.app.runs.applications.config import ModelConfig
from dvax.app.runs.applications.run import ApplicationRun
from dvax.app.runs.config import Config
from dvax.app.runs.contact_run import ContactRun
from dvax.app.runs.interrupt import interruptible, terminable
from dvax.app.runs.json_files import read_object
from dvax.app.runs.run import AbstractRun, Listener, RunOutcome
from dvax.app.runs.rundir import RunDirectory, target_problems
from dvax.errors import input_error


def run(
    config: Config | ModelConfig,
    out: Path,
    *,
    overwrite: bool = False,
    on_event: Listener | None = None,
) -> RunOutcome:
    """Solve what `config` describes and leave a run directory at `out`.

    `on_event` is called with dicts whose "event" is compiled, progress, warning or
    stopped; of an application also stage.

    **Raises:** `dvax.InputError`, with nothing written, where `out` cannot be written or where data
    files no longer fit. A failure of the solve is not raised: it is the outcome, and what was computed
    before is on disk.
    """
    target_problems(out, force=overwrite).raise_any()
    tell = on_event or (lambda event: None)

    with terminable():
        task = interruptible(lambda: _prepared(config, tell))
        # The folder stays empty until a manifest can describe it.
        directory = RunDirectory(out, clear=True)
        try:
            return task.go(directory)
        finally:
            directory.close()


def resume(
    config: Config | ModelConfig, directory: Path, on_event: Listener | None = None
) -> RunOutcome:
    """Go on with a run that ended early, from its checkpoints; `config` is its resolved one. The
    results are those of a run that was not interrupted.

    **Raises:** `dvax.InputError` if another process writes the run or has finished it, or if
    configuration, data or versions have changed.
    """
    with terminable():
        # First of all the lock, since a run that another process finished is not to be done again.
        opened = RunDirectory(directory, clear=False)
        try:
            if read_object(directory / "manifest.json").get("status") == "finished":
                raise input_error(
                    str(directory), "a finished run", "there is nothing to go on with",
                    "See its report.html",
                )  # fmt: skip
            task = interruptible(lambda: _prepared(config, on_event or (lambda event: None)))
            return task.go(opened, resume=True)
        finally:
            opened.close()


def _prepared(config: Config | ModelConfig, tell: Listener) -> AbstractRun:
    if isinstance(config, ModelConfig):
        return ApplicationRun(config, tell)
    return ContactRun(config, tell)
