"""The command line: `dvax run`, `check`, `report`, `demo`, `doctor`.

Thin: it reads what the user typed, calls the rooms below, and says what came of it. Nothing heavy
is imported before a command needs it, so that `dvax --help` answers at once.
"""

import os
import sys
from typing import NoReturn

_STOPPED = (130, 143)


def main() -> None:
    """The entry point of the `dvax` program."""
    from dvax.app.runs.interrupt import LONGEST, end_within, exit_code, terminable

    end_within(LONGEST)
    try:
        with terminable():
            _start()
    except KeyboardInterrupt as stop:  # after all that a command does
        _end(exit_code(stop))
    except SystemExit as stop:
        if stop.code not in _STOPPED:
            raise
        _end(int(stop.code or 1))


def _start() -> None:
    try:
        from dvax.app.cli.program import app
    except ModuleNotFoundError as missing:
        if missing.name is None or missing.name.split(".")[0] == "dvax":
            raise
        sys.exit(
            f"The command line needs the package {missing.name}, which is not installed. "
            "Install dvax with its application: pip install 'dvax[app]'."
        )
    app()


def _end(code: int) -> NoReturn:
    # All is on disk. The compiler cannot be interrupted: it may still be at work in threads of its own,
    # and taking the interpreter down around them ends in a crash.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
