"""`dvax report DIR`: make the report of a run again."""

from pathlib import Path
from typing import Annotated

import typer

from dvax.cli.failure import reported
from dvax.cli.options import Debug
from dvax.cli.talk import remark, say


def report(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="The folder that `dvax run` wrote.")
    ],
    debug: Debug = False,
) -> None:
    """Write report.html and figures/*.png of a run, finished or not."""
    with reported(debug, directory):
        from dvax.runs.interrupt import interruptible

        interruptible(_import)
        from dvax.plots import build_report
        from dvax.runs.rundir import close_killed

        if close_killed(directory):
            remark("the run was killed: its complete frames are kept")
        say(str(interruptible(lambda: build_report(directory))))


def _import() -> None:
    import dvax.plots
    import dvax.runs.rundir  # noqa: F401
