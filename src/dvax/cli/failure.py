"""What an error becomes: all its problems on the screen, and an exit code for scripts."""

import errno
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from dvax.cli.talk import complain, complain_of
from dvax.errors import DvaxError, InputError, SolveError

BAD_INPUT, SOLVER_FAILED, OUT_OF_CLASS, INTERRUPTED = 2, 3, 4, 130


@contextmanager
def reported(debug: bool) -> Iterator[None]:
    """Say what went wrong without a traceback (with `debug`, after one) and exit with its code.

    An exception that is none of these is a defect of dvax: it is left to Python, traceback and all.
    """
    try:
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
        place = error.filename or "a file"
        complain(f"error: {place}: {error.strerror or error}. Make it accessible.")
        # A full disk stops work that was under way; the rest is a path that was given wrongly.
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        raise typer.Exit(SOLVER_FAILED if full else BAD_INPUT) from error
    except KeyboardInterrupt as error:
        _trace(debug)
        complain("interrupted")
        raise typer.Exit(INTERRUPTED) from error


def _trace(debug: bool) -> None:
    if debug:
        complain(traceback.format_exc())
