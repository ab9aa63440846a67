"""Data files: permitted places and sizes, and fingerprints."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dvax.errors import InputError, input_error
from dvax.formats.table import read_bytes

MAX_BYTES = 256 * 2**20


@dataclass(frozen=True)
class DataFile:
    """A file that a run has read: its name in the configuration, its size and its hash."""

    name: str
    path: Path
    bytes: int
    sha256: str


def locate(name: str, folder: Path, allow_outside: bool, place: str) -> Path:
    """The file that a configuration in `folder` calls `name`.

    Raises `InputError` where it is missing, no regular file, too large, or outside the folder
    without `allow_outside`: a configuration from elsewhere must not read other people's files.
    """
    resolved, size = _resolved(name, folder, allow_outside, place, Path.is_file)
    if size is None and resolved.is_dir():
        raise _refuse(place, name, "it is a folder, and this is for a file", "Name a file in it.")
    if size is None:
        where = Path(folder.resolve().name) / name
        raise _refuse(place, name, "there is no such file", f"Put it at {where} or fix the name.")
    if size > MAX_BYTES:
        raise _refuse(
            place, name, f"it has {size} bytes and a data file at most {MAX_BYTES}",
            "Thin the data out.",
        )  # fmt: skip
    return resolved


def locate_folder(name: str, folder: Path, allow_outside: bool, place: str) -> Path:
    """The folder of data that a configuration in `folder` calls `name`; see `locate`."""
    resolved, size = _resolved(name, folder, allow_outside, place, Path.is_dir)
    if size is None:
        what = (
            "it is a file, and this is for a folder"
            if resolved.is_file()
            else "there is no such folder"
        )
        raise _refuse(place, name, what, "Fix the name.")
    return resolved


def _resolved(
    name: str, folder: Path, allow_outside: bool, place: str, kind: Callable[[Path], bool]
) -> tuple[Path, int | None]:
    """Return the path, and its size where it is of the kind, else None."""
    if not name or "\x00" in name:
        raise _refuse(place, name, "this is no file name", "Name a file beside the configuration.")
    path = Path(name) if allow_outside and Path(name).is_absolute() else folder / name
    try:
        resolved = path.resolve()
        inside = resolved.is_relative_to(folder.resolve())
        size = resolved.stat().st_size if kind(resolved) else None
    except (OSError, RuntimeError) as error:
        raise _refuse(
            place, name, f"it cannot be opened: {error}", "Check the name and the permissions."
        ) from None
    if not inside and not allow_outside:
        raise _refuse(
            place,
            name,
            "data lies in the configuration's folder or below it",
            "Copy it there, or pass --allow-outside.",
        )
    return resolved, size


def _refuse(place: str, name: str, rule: str, fix: str) -> InputError:
    return input_error(place, repr(name), rule, fix)


def fingerprint(name: str, path: Path) -> DataFile:
    """Return the size and the SHA-256 of a file, which identify the data of a run."""
    content = read_bytes(path)
    return DataFile(name, path, len(content), hashlib.sha256(content).hexdigest())
