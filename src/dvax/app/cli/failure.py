"""What an error becomes: all its problems on the screen, and an exit code for scripts."""

import errno
import shutil
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import typer

from dvax.app.cli.console import complain, complain_of
from dvax.errors import DvaxError, InputError, SolveError

BAD_INPUT, SOLVER_FAILED, OUT_OF_CLASS, DISK_FULL = 2, 3, 4, 5
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def reported(debug: bool, out: Path | None = None) -> Iterator[None]:
    """Say what went wrong without a traceback (with `debug`, after one) and exit with its code.

    An exception that is none of these is a defect of dvax: it is left to Python, traceback and all.
    """
    from dvax.app.runs.interrupt import TERMINATED, exit_code, terminable

    try:
        with terminable():
            yield
    except InputError as error:
        _trace(debug)
        complain_of(error)
        raise typer.Exit(BAD_INPUT) from error
    except SolveError as error:
        _trace(debug)
        complain(f"error: {error}")
        raise typer.Exit(SOLVER_FAILED) from error
    except DvaxError as error:
        _trace(debug)
        complain(f"error: {error}")
        raise typer.Exit(BAD_INPUT) from error
    except OSError as error:
        _trace(debug)
        if error.errno in _FULL:
            complain(_full(error, out))
            raise typer.Exit(DISK_FULL) from error
        place = error.filename or out or "a file"
        complain(f"error: {place}: {error.strerror or error}. Make it accessible.")
        raise typer.Exit(BAD_INPUT) from error
    except KeyboardInterrupt as stop:
        _trace(debug)
        code = exit_code(stop)
        complain("terminated" if code == TERMINATED else "interrupted")
        raise typer.Exit(code) from stop


def _full(error: OSError, out: Path | None) -> str:
    """What to do where nothing more can be written: the place, what is left there, the way out."""
    place = Path(error.filename or out or Path.cwd())
    folder = next((p for p in (place, *place.parents) if p.is_dir()), Path.cwd())
    left = shutil.disk_usage(folder).free / 2**20
    return (
        f"error: {place}: {error.strerror}; {left:.4g} MiB are free there. Free some space or raise "
        "the limit, or give another folder with -o. What was complete before is kept."
    )


def _trace(debug: bool) -> None:
    if debug:
        complain(traceback.format_exc())
