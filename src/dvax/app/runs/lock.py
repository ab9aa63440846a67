"""Locks on files, so that one process at a time writes."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from dvax.errors import input_error

NAME = ".lock"


def lock(directory: Path) -> IO[str]:
    """Return the locked file of a run directory; closing it, or the end of the process, unlocks it.

    **Raises:** `dvax.InputError` while another process holds it.
    """
    file = (directory / NAME).open("a+", encoding="utf-8")
    if not _flock(file, wait=False):
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


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """In the block this process alone holds the lock of a file; it waits for another one's end."""
    with path.open("a+", encoding="utf-8") as file:
        _flock(file, wait=True)
        yield


def _flock(file: IO[str], *, wait: bool) -> bool:
    """Lock an open file. Returns whether it is locked now."""
    try:
        import fcntl
    except ModuleNotFoundError:  # not on Windows
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    return True
