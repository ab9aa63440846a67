"""`dvax demo`: the rough contact strip that dvax brings along."""

from importlib.resources import as_file, files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from dvax.app.cli.failure import reported
from dvax.app.cli.load import load
from dvax.app.cli.options import Debug, Force, Quiet
from dvax.app.cli.resample import resample
from dvax.app.cli.run import carry_out

CONFIG = "rough_strip.toml"


def demo(
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="The folder for the results.")
    ] = Path("demo-run"),
    points: Annotated[
        int | None,
        typer.Option("--points", metavar="N", min=1, help="Sample the strip at N points."),
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Solve a rough contact strip under an irregular load."""
    with reported(debug, out):
        from dvax.app.runs.interrupt import interruptible
        from dvax.app.runs.rundir import target_problems

        target_problems(out, force=force).raise_any()

        # The folders must outlive the run, which copies the data it names.
        with as_file(files("dvax.app.runs") / "demo") as shipped, TemporaryDirectory() as sampled:
            config = shipped / CONFIG
            if points is not None:
                sample = Path(sampled)
                config = interruptible(lambda: resample(shipped / CONFIG, sample, points))
            loaded = interruptible(lambda: load(config, False))
            carry_out(loaded, out, force=force, quiet=quiet)
