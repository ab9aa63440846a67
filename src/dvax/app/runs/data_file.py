"""Data files: permitted places and sizes, and fingerprints."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from dvax.app.runs.schema_errors import shown
from dvax.errors import InputError, input_error
from dvax.formats.table import read_bytes

MAX_BYTES = 256 * 2**20
MAX_NAME = 4096
"""The longest path of Linux, in bytes; longer ones take long to resolve."""


@dataclass(frozen=True)
class DataFile:
    """A file that a run has read: its name in the configuration, its size and its hash."""

    name: str
    path: Path
    bytes: int
    sha256: str


def locate(
    name: str, folder: Path, allow_outside: bool, place: str, *, is_folder: bool = False
) -> Path:
    """The file (or folder, with `is_folder`) that a configuration in `folder` calls `name`.

    Raises `InputError` where it is missing, of another kind, too large, or outside the folder
    without `allow_outside`: a configuration from elsewhere must not read other people's files.
    """

    def refuse(rule: str, fix: str) -> InputError:
        return input_error(place, shown(name), rule, fix)

    if not name or "\x00" in name or len(name) > MAX_NAME:
        raise refuse("this is no file name", "Name a file beside the configuration.")
    if "\n" in name:
        fix = "Save it as a file beside the configuration, and write its name here."
        raise refuse("it must be the name of a file, and this is the text of one", fix)
    path = Path(name) if allow_outside and Path(name).is_absolute() else folder / name
    try:
        resolved = path.resolve()
        inside = resolved.is_relative_to(folder.resolve())
        file, directory = resolved.is_file(), resolved.is_dir()
        size = resolved.stat().st_size if file else 0
    except (OSError, RuntimeError) as error:
        fix = "Check the name and the permissions."
        reason = getattr(error, "strerror", None) or "its links form a loop"
        raise refuse(f"it cannot be opened: {reason}", fix) from None
    if not inside and not allow_outside:
        rule = "data lies in the configuration's folder or below it"
        raise refuse(rule, "Copy it there, or pass --allow-outside.")
    if is_folder and not directory:
        rule = "it is a file, and this is for a folder" if file else "there is no such folder"
        raise refuse(rule, "Fix the name.")
    if not is_folder and directory:
        raise refuse("it is a folder, and this is for a file", "Name a file in it.")
    if not is_folder and not file:
        where, here = folder.resolve() / name, Path.cwd()
        shown_path = where.relative_to(here) if where.is_relative_to(here) else where
        raise refuse("there is no such file", f"Put it at {shown_path} or fix the name.")
    if size > MAX_BYTES:
        rule = f"it has {size} bytes and a data file at most {MAX_BYTES}"
        raise refuse(rule, "Thin the data out.")
    return resolved


def fingerprint(name: str, path: Path) -> DataFile:
    """Return the size and the SHA-256 of a file, which identify the data of a run."""
    content = read_bytes(path)
    return DataFile(name, path, len(content), hashlib.sha256(content).hexdigest())
