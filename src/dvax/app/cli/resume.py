"""`dvax resume DIR`: go on with a run that ended early."""

from pathlib import Path
from typing import Annotated

import typer

from dvax.app.cli.console import print_remark
from dvax.app.cli.failure import reported
from dvax.app.cli.load import load
from dvax.app.cli.options import AllowCode, Debug, Quiet
from dvax.app.cli.run import carry_out
from dvax.errors import input_error


def resume(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="The folder that `dvax run` wrote.")
    ],
    allow_code: AllowCode = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Go on with a run that was interrupted, killed, or that failed, from its last checkpoint."""
    with reported(debug, directory):
        from dvax.app.runs.interrupt import interruptible
        from dvax.app.runs.resolved import NAME

        if _status(directory) == "finished":
            print_remark(f"{directory}: the run is finished, there is nothing to go on with")
            return
        loaded = interruptible(lambda: load(directory / NAME, False, quiet, allow_code=allow_code))
        carry_out(loaded, directory, resume=True, quiet=quiet)


def _status(directory: Path) -> str:
    from dvax.app.runs.json_files import read_object
    from dvax.app.runs.resolved import NAME

    status = read_object(directory / "manifest.json").get("status", "")
    if not status and not (directory / NAME).is_file():
        raise input_error(
            str(directory), "no run of dvax" if directory.is_dir() else "no such folder",
            f"a run that can go on has {NAME} and checkpoints", "Give the folder of dvax run -o DIR",
        )  # fmt: skip
    return str(status)
