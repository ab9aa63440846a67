"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

Debug = Annotated[bool, typer.Option("--debug", help="Show the Python traceback of an error.")]
Force = Annotated[bool, typer.Option("--force", help="Replace the run that DIR holds.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but warnings and errors.")]
ConfigFile = Annotated[
    Path, typer.Argument(metavar="CONFIG.toml", help="The configuration of the run.")
]
AllowCode = Annotated[
    bool,
    typer.Option("--allow-code", help="Run the Python file that CONFIG.toml names as its model."),
]
AllowOutside = Annotated[
    bool,
    typer.Option("--allow-outside", help="Let CONFIG.toml name data outside of its own folder."),
]
