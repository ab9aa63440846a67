"""Files of data: where they may lie, how large they may be, and their fingerprint."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from dvax.errors import InputError, InputProblem

MAX_BYTES = 256 * 2**20


@dataclass(frozen=True)
class DataFile:
    """A file that a run has read: as the configuration names it, and what it held."""

    name: str
    path: Path
    bytes: int
    sha256: str


def locate(name: str, folder: Path, allow_outside: bool, place: str) -> Path:
    """The file that a configuration in `folder` calls `name`.

    Raises `InputError` where it is missing, no regular file, too large, or outside the folder
    without `allow_outside`: a configuration from elsewhere must not read other people's files.
    """

    def refuse(rule: str, mend: str) -> InputError:
        return InputError(InputProblem(place, repr(name), rule, mend))

    if not name or "\x00" in name:
        raise refuse("this is no file name", "Name a file beside the configuration.")
    path = Path(name) if allow_outside and Path(name).is_absolute() else folder / name
    try:
        resolved = path.resolve()
        inside = resolved.is_relative_to(folder.resolve())
        size = resolved.stat().st_size if resolved.is_file() else None
    except (OSError, RuntimeError) as error:
        raise refuse(
            f"it cannot be opened: {error}", "Check the name and the permissions."
        ) from None
    if not inside and not allow_outside:
        raise refuse(
            "data lies in the configuration's folder or below it",
            "Copy the file there, or allow files outside.",
        )
    if size is None:
        raise refuse("there is no such file", f"Put it at {folder.name}/{name} or mend the name.")
    if size > MAX_BYTES:
        raise refuse(
            f"it has {size} bytes and a data file at most {MAX_BYTES}", "Thin the data out."
        )
    return resolved


def read_bytes(path: Path) -> bytes:
    """The content of a located file. Raises `InputError` where the system refuses to read it."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            InputProblem(
                path.name,
                error.strerror or str(error),
                "a data file must be readable",
                "Check its permissions.",
            )
        ) from None


def fingerprint(name: str, path: Path) -> DataFile:
    """Size and SHA-256 of a file, by which a run can be recognised."""
    content = read_bytes(path)
    return DataFile(name, path, len(content), hashlib.sha256(content).hexdigest())
