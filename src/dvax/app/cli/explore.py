"""`dvax explore [TARGET]`: a local page with sliders."""

import errno
import os
import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from dvax.app.cli.console import print_line, print_remark
from dvax.app.cli.failure import reported
from dvax.app.cli.options import AllowCode, AllowOutside, Debug
from dvax.errors import input_error

if TYPE_CHECKING:
    from dvax.app.explore.server import Server


def explore(
    target: Annotated[
        Path | None,
        typer.Argument(
            metavar="TARGET",
            help="CONFIG.toml of any model, or the folder of a run; without it, the contact law.",
        ),
    ] = None,
    port: Annotated[
        int, typer.Option("--port", metavar="N", min=0, max=65535, help="0: any free port.")
    ] = 0,
    browser: Annotated[
        bool, typer.Option("--open/--no-browser", help="Open the page in the browser.")
    ] = True,
    allow_outside: AllowOutside = False,
    allow_code: AllowCode = False,
    debug: Debug = False,
) -> None:
    """Serve a page on this computer: move parameters and see the solution. Ctrl-C ends it."""
    with reported(debug, target):
        from dvax.app.runs.interrupt import interruptible

        server = interruptible(lambda: _server(target, port, allow_outside, allow_code))
        print_line(server.url)
        print_remark("Only this computer can open the page. Ctrl-C ends it.")
        if browser and _has_screen():
            webbrowser.open(server.url)
        try:
            interruptible(server.serve_forever)
        except KeyboardInterrupt:
            _end()


def _server(target: Path | None, port: int, allow_outside: bool, allow_code: bool) -> "Server":
    """Return the server, which listens already."""
    from dvax.app.runs.compilation_cache import enable_compilation_cache, enable_double

    enable_double()
    enable_compilation_cache()
    from dvax.app.explore.open_subject import open_subject
    from dvax.app.explore.server import ADDRESS, Server

    subject = open_subject(target, allow_outside=allow_outside, allow_code=allow_code)
    try:
        return Server(subject, port)
    except OSError as error:
        if error.errno not in (errno.EADDRINUSE, errno.EACCES):
            raise
        raise input_error(
            "--port", f"{ADDRESS}:{port}, {error.strerror}", "the port is free and may be used",
            "Give another one, or 0 for any that is free",
        ) from error  # fmt: skip


def _has_screen() -> bool:
    """Return whether a browser can open a window: one for terminals would take over this terminal."""
    return sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))


def _end() -> NoReturn:
    # A solve may be running, and an interpreter that shuts down while compiled code runs crashes.
    print_remark("stopped")
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)
