"""From an error to all its problems on the screen, and to an exit code for scripts."""

import errno
import shutil
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import typer

from dvax.app.cli.console import print_error, print_problems
from dvax.errors import DvaxError, InputError, SolveError

BAD_INPUT, SOLVER_FAILED, OUT_OF_CLASS, DISK_FULL = 2, 3, 4, 5
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def reported(debug: bool, out: Path | None = None) -> Iterator[None]:
    """Print what went wrong without a traceback (with `debug`, after one) and exit with its code.

    Any other exception is a defect of dvax, and Python prints its traceback.
    """
    from dvax.app.runs.interrupt import TERMINATED, exit_code, terminable

    try:
        with terminable():
            yield
    except InputError as error:
        _trace(debug)
        print_problems(error)
        raise typer.Exit(BAD_INPUT) from error
    except DvaxError as error:
        _trace(debug)
        print_error(f"error: {error}")
        code = SOLVER_FAILED if isinstance(error, SolveError) else BAD_INPUT
        raise typer.Exit(code) from error
    except OSError as error:
        _trace(debug)
        if error.errno in _FULL:
            print_error(_full(error, out))
            raise typer.Exit(DISK_FULL) from error
        place = error.filename or out or "a file"
        print_error(f"error: {place}: {error.strerror or error}. Make it accessible.")
        raise typer.Exit(BAD_INPUT) from error
    except KeyboardInterrupt as stop:
        _trace(debug)
        code = exit_code(stop)
        print_error("terminated" if code == TERMINATED else "interrupted")
        raise typer.Exit(code) from stop


def _full(error: OSError, out: Path | None) -> str:
    """The message for a full disk: the place, the free space there, and the fix."""
    place = Path(error.filename or out or Path.cwd())
    folder = next((p for p in (place, *place.parents) if p.is_dir()), Path.cwd())
    left = shutil.disk_usage(folder).free / 2**20
    return (
        f"error: {place}: {error.strerror}; {left:.4g} MiB are free there. Free some space or raise "
        "the limit, or give another folder with -o. What was complete before is kept."
    )


def _trace(debug: bool) -> None:
    if debug:
        print_error(traceback.format_exc())
