"""`dvax new DIR`: a problem of your own to start from."""

from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from dvax.app.cli.console import print_line
from dvax.app.cli.failure import reported
from dvax.app.cli.options import Debug
from dvax.errors import input_error

FILES = ("spring.toml", "spring.py", "test_spring.py", "sweep.toml")


def new(
    out: Annotated[Path, typer.Argument(metavar="DIR", help="The folder to make.")],
    debug: Debug = False,
) -> None:
    """Write a small problem of your own: a Python file, its configuration, a test, a sweep."""
    with reported(debug, out):
        taken = [name for name in FILES if (out / name).exists()]
        if taken or (out.exists() and not out.is_dir()):
            raise input_error(
                str(out), f"a folder with {', '.join(taken)}" if taken else "a file",
                "no file is written over another one", "Give another folder",
            )  # fmt: skip
        out.mkdir(parents=True, exist_ok=True)
        source = files("dvax.app.runs") / "new"
        for name in FILES:
            (out / name).write_text((source / f"{name}.txt").read_text("utf-8"), "utf-8")
        print_line(f"wrote {', '.join(FILES)} into {out}")
        print_line(f"next: dvax check {out / FILES[0]} --allow-code")
