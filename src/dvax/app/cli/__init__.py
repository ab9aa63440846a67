"""The command line: `dvax new`, `check`, `run`, `resume`, `sweep`, `report`, `explore`, `export`,
`demo`, `doctor`.

It reads the arguments, calls `runs` and `plots`, and prints the outcome. Nothing heavy is imported
before a command needs it, so that `dvax --help` answers at once.
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
    # All results are on disk. The compiler cannot be interrupted, and an interpreter that shuts down
    # while compiler threads run crashes: end the process at once.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
