"""The program `dvax` and its commands."""

from typing import Annotated

import typer

from dvax.app.cli.check import check
from dvax.app.cli.demo import demo
from dvax.app.cli.doctor import doctor
from dvax.app.cli.explore import explore
from dvax.app.cli.export import export
from dvax.app.cli.new import new
from dvax.app.cli.report import report
from dvax.app.cli.resume import resume
from dvax.app.cli.run import run
from dvax.app.cli.sweep import sweep

app = typer.Typer(
    name="dvax",
    no_args_is_help=True,
    # Tracebacks are Python's own, for defects and with --debug; user errors have none.
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help=(
        "Solve coupled nonsmooth dynamical systems, with a certificate of the error.\n\n"
        "Exit codes: 0 done, 2 wrong input, 3 the solver failed, 4 outside the class of problems "
        "(check), 5 no space left to write, 130 interrupted, 143 asked to terminate. Whatever "
        "ends a run, the frames that were solved until then are kept."
    ),
)


def _version(asked: bool) -> None:
    if asked:
        from dvax import __version__

        typer.echo(f"dvax {__version__}")
        raise typer.Exit()


@app.callback()
def _program(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Options of the program itself; each command has its own."""


for command in (new, check, run, resume, sweep, report, explore, export, demo, doctor):
    app.command()(command)
