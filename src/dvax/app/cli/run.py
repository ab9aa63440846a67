"""`dvax run CONFIG.toml -o DIR`: from a configuration to a certified solution on disk."""

import math
from contextlib import suppress
from pathlib import Path
from shlex import quote
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dvax._figure_text import entry_text
from dvax.app.cli.console import print_line, print_problems, print_remark, print_table
from dvax.app.cli.failure import BAD_INPUT, reported
from dvax.app.cli.load import load
from dvax.app.cli.options import AllowCode, AllowOutside, ConfigFile, Debug, Force, Quiet
from dvax.app.cli.progress import progress
from dvax.errors import InputError

if TYPE_CHECKING:
    from dvax.app.runs.applications.config import ModelConfig
    from dvax.app.runs.config import Config
    from dvax.app.runs.run import RunOutcome


def run(
    config: ConfigFile,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="The folder for the results.")
    ],
    force: Force = False,
    quiet: Quiet = False,
    allow_outside: AllowOutside = False,
    allow_code: AllowCode = False,
    debug: Debug = False,
) -> None:
    """Solve the system that CONFIG.toml describes; results, manifest and report go into DIR."""
    with reported(debug, out):
        from dvax.app.runs.interrupt import interruptible
        from dvax.app.runs.rundir import target_problems

        # Both are checked before anything is refused, so that one round is enough to fix all of it.
        problems = target_problems(out, force=force)
        try:
            loaded = interruptible(lambda: load(config, allow_outside, quiet, allow_code))
        except InputError as error:
            raise InputError(*error.problems, *problems) from error
        problems.raise_any()
        carry_out(loaded, out, force=force, quiet=quiet)


def carry_out(
    config: "Config | ModelConfig",
    out: Path,
    *,
    force: bool = False,
    quiet: bool = False,
    resume: bool = False,
) -> None:
    """Run a checked configuration, or go on with its run, make its report, print the figures; exit
    with the run's code."""
    from dvax.app.runs.interrupt import interruptible

    interruptible(_import)
    from dvax.app.runs import driver
    from dvax.app.runs.applications.config import OWN

    if config.output.report:
        # Plotly and Matplotlib take two seconds to import: beside the solve they cost nothing.
        Thread(target=_import_plots, name="dvax import", daemon=True).start()
    with progress(quiet=quiet) as listener:
        if resume:
            outcome = driver.resume(config, out, listener)
        else:
            outcome = driver.run(config, out, overwrite=force, on_event=listener)
    if not quiet:
        _print_figures(outcome.summary)
        _print_useless_bound(config, outcome.summary)
    if outcome.exit_code:
        print_remark(f"{outcome.status}: {outcome.stop_reason}", "bold red")
        kept = (
            "what was computed until then is"
            if outcome.has_results
            else "the settings and the log are"
        )
        print_remark(f"{kept} in {outcome.directory}")
        if outcome.status == "interrupted":
            flag = " --allow-code" if getattr(config, "name", "") == OWN else ""
            print_remark(f"to go on: dvax resume {quote(str(outcome.directory))}{flag}")
    elif not quiet:
        print_remark(f"{outcome.status}: {outcome.stop_reason}")
    if config.output.report:
        _report(outcome, config.output.png, quiet)
    if outcome.exit_code:
        raise typer.Exit(outcome.exit_code)


def _import() -> None:
    import dvax.app.runs.driver  # noqa: F401


def _import_plots() -> None:
    with suppress(Exception):  # an import that fails is reported where the report is made
        import dvax.app.plots.report  # noqa: F401


def _report(outcome: "RunOutcome", png: bool, quiet: bool) -> None:
    """Make the report of a run, also of one that stopped early."""
    from dvax.app.runs.interrupt import interruptible, patience

    interrupted = outcome.status == "interrupted"

    def draw() -> Any:
        from dvax.app.plots.report import draw_report

        # After an interrupt time is short, and PNGs take the longest.
        return draw_report(outcome.directory, stills=png and not interrupted)

    try:
        page = interruptible(draw, patience() if interrupted else math.inf).write()
        if not quiet:
            print_remark(f"report: {page}")
    except InputError as error:
        # The run itself is complete, and its folder says how it ended.
        print_problems(error, f"the run is in {outcome.directory}, without a report")
        raise typer.Exit(outcome.exit_code or BAD_INPUT) from error
    except (KeyboardInterrupt, TimeoutError):
        if not interrupted:
            raise
        print_remark(f"for its report: dvax report {outcome.directory}")


def _print_useless_bound(config: "Config | ModelConfig", summary: dict[str, Any]) -> None:
    """Say if the error bound certifies no digit, and what to try."""
    from dvax.app.runs.state_bound import REMEDY, useless_bound

    model = getattr(config, "model", None)
    said = useless_bound(summary, getattr(model, "remedy", REMEDY))
    if said is not None:
        print_remark(f"note: {said}")


def _print_figures(summary: dict[str, Any]) -> None:
    """The model's headline figures: name, value, unit, meaning."""
    rows = []
    for name, entry in summary.items():
        if name == "status":
            continue  # it is the last line, and in the exit code
        unit = "" if entry["unit"] == "1" or entry["value"] is None else entry["unit"]
        rows.append((name, f"{entry_text(entry)} {unit}".strip(), entry["meaning"]))
    if rows:
        print_table(("figure", "value", "meaning"), rows)
        print_line("")
