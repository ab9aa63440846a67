"""`dvax run CONFIG.toml -o DIR`: from a configuration to a certified solution on disk."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dvax._figure_text import entry_text
from dvax.app.cli.console import complain_of, remark, say, table
from dvax.app.cli.failure import BAD_INPUT, reported
from dvax.app.cli.load import load
from dvax.app.cli.options import AllowOutside, ConfigFile, Debug, Force, Quiet
from dvax.app.cli.preload import loaded_ahead
from dvax.app.cli.progress import progress
from dvax.app.cli.target import target_problems
from dvax.errors import InputError, InputProblem

if TYPE_CHECKING:
    from dvax.app.plots.report import Report
    from dvax.app.runs.applications.config import ModelConfig
    from dvax.app.runs.config import Config


def run(
    config: ConfigFile,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="The folder for the results.")
    ],
    force: Force = False,
    quiet: Quiet = False,
    allow_outside: AllowOutside = False,
    debug: Debug = False,
) -> None:
    """Solve the system that CONFIG.toml describes; results, manifest and report go into DIR."""
    with reported(debug, out):
        from dvax.app.runs.interrupt import interruptible

        # Both are checked before anything is refused: one round is enough to fix all of it.
        problems: list[InputProblem] = target_problems(out, force=force)
        try:
            loaded = interruptible(lambda: load(config, allow_outside, quiet))
        except InputError as error:
            raise InputError(*error.problems, *problems) from error
        if problems:
            raise InputError(*problems)
        carry_out(loaded, out, force=force, quiet=quiet)


def carry_out(config: "Config | ModelConfig", out: Path, *, force: bool, quiet: bool) -> None:
    """Run a checked configuration, make its report, say the figures; exit with the run's code."""
    from dvax.app.runs.interrupt import interruptible, patience

    interruptible(_import)
    from dvax.app.runs.applications.config import ModelConfig
    from dvax.app.runs.applications.driver import run_model
    from dvax.app.runs.driver import run as drive

    unit = "" if isinstance(config, ModelConfig) else config.units.time
    with progress(unit, quiet=quiet) as listener:
        if config.output.report:
            listener = loaded_ahead("dvax.app.plots", listener)
        if isinstance(config, ModelConfig):
            outcome = run_model(config, out, overwrite=force, on_event=listener)
        else:
            outcome = drive(config, out, overwrite=force, on_event=listener)
    if not quiet:
        _say_figures(outcome.summary)
    if outcome.exit_code:
        remark(f"{outcome.status}: {outcome.stop_reason}", "bold red")
        known = outcome.has_results
        kept = "what was computed until then is" if known else "the settings and the log are"
        remark(f"{kept} in {outcome.directory}")
    elif not quiet:
        remark(f"{outcome.status}: {outcome.stop_reason}")
    if config.output.report:
        stopped = outcome.status == "interrupted"
        # Who interrupts a run waits for its end: the stills would take the longest.
        stills = config.output.png and not stopped
        try:
            drawn = interruptible(
                lambda: _draw(outcome.directory, stills), patience() if stopped else math.inf
            )
            page = drawn.write()
            if not quiet:
                remark(f"report: {page}")
        except InputError as error:
            # The run itself is complete, and its folder says how it ended.
            complain_of(error, f"the run is in {outcome.directory}, without a report")
            raise typer.Exit(outcome.exit_code or BAD_INPUT) from error
        except (KeyboardInterrupt, TimeoutError):
            if not stopped:
                raise
            remark(f"for its report: dvax report {outcome.directory}")
    if outcome.exit_code:
        raise typer.Exit(outcome.exit_code)


def _import() -> None:
    import dvax.app.runs.applications.driver  # noqa: F401


def _draw(directory: Path, stills: bool) -> "Report":
    from dvax.app.plots.report import draw_report

    return draw_report(directory, stills=stills)


def _say_figures(summary: dict[str, Any]) -> None:
    """The model's headline figures: name, value, unit, meaning."""
    rows = []
    for name, entry in summary.items():
        if name == "status":
            continue  # it is the last line, and in the exit code
        shown = entry_text(entry)
        unit = "" if entry["unit"] == "1" else entry["unit"]
        rows.append((name, f"{shown} {unit}".strip(), entry["meaning"]))
    if rows:
        table(("figure", "value", "meaning"), rows)
        say("")
