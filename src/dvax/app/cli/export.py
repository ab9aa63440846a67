"""`dvax export DIR -o FILE`: the results of a run for other programs."""

from pathlib import Path
from shutil import rmtree
from typing import Annotated

import typer

from dvax.app.cli.console import print_line, print_remark
from dvax.app.cli.failure import reported
from dvax.app.cli.options import Debug


def export(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="The folder that `dvax run` wrote.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="The file (.nc, .csv, .npz, .parquet, .pvd), or a folder with --format.",
        ),
    ],
    format: Annotated[
        str | None,
        typer.Option(
            "--format", help="netcdf, csv, npz, parquet or vtk; by default that of the ending."
        ),
    ] = None,
    variables: Annotated[
        str | None,
        typer.Option("--variables", metavar="A,B", help="Only these, with their coordinates."),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace files of the same names.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Write the results of a run, finished or not, as NetCDF, CSV, NPZ, Parquet or VTK."""
    with reported(debug, out):
        from dvax.app.runs.interrupt import interruptible

        names = None if variables is None else [n.strip() for n in variables.split(",")]
        notes: list[str] = []

        def work() -> list[Path]:
            from dvax.app.runs.export import export_run

            return export_run(
                directory, out, format=format, variables=names, force=force, say=notes.append
            )

        try:
            written = interruptible(work)
        except KeyboardInterrupt:
            from dvax.app.runs.export.export import staging_folder

            # The thread that writes there ends with the process.
            rmtree(staging_folder(out), ignore_errors=True)
            raise
        for note in notes:
            print_remark(f"note: {note}")
        for path in written:
            print_line(str(path))
