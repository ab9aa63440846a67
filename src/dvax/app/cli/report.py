"""`dvax report DIR`: make the report of a run again."""

from pathlib import Path
from typing import Annotated

import typer

from dvax.app.cli.console import print_line, print_remark
from dvax.app.cli.failure import reported
from dvax.app.cli.options import Debug


def report(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="The folder that `dvax run` wrote.")
    ],
    debug: Debug = False,
) -> None:
    """Write report.html and figures/*.png of a run, finished or not."""
    with reported(debug, directory):
        from dvax.app.runs.interrupt import interruptible

        interruptible(_import)
        from dvax.app.plots import build_report
        from dvax.app.runs.rundir import close_killed

        if close_killed(directory):
            print_remark("the run was killed: its complete frames are kept")
        print_line(str(interruptible(lambda: build_report(directory))))


def _import() -> None:
    import dvax.app.plots.report
    import dvax.app.runs.rundir  # noqa: F401
