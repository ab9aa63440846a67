"""A lock on a run directory, so that one process at a time writes into it."""

import os
from pathlib import Path
from typing import IO

from dvax.errors import input_error

NAME = ".lock"


def lock(directory: Path) -> IO[str]:
    """Return the locked file of a run directory; closing it, or the end of the process, unlocks it.

    **Raises:** `dvax.InputError` while another process holds it.
    """
    file = (directory / NAME).open("a+", encoding="utf-8")
    try:
        import fcntl
    except ModuleNotFoundError:  # not on Windows
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.seek(0)
        process = file.read().strip()
        file.close()
        raise input_error(
            str(directory), "a folder that another process writes into",
            f"one process at a time writes a run; it is number {process or 'unknown'}",
            "Wait for its end, or give another folder",
        ) from None  # fmt: skip
    file.seek(0)
    file.truncate()
    file.write(str(os.getpid()))
    file.flush()
    return file
