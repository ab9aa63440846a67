"""Files that are replaced as a whole, and the metadata of Zarr stores."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def write_whole(file: Path, content: bytes) -> None:
    """Write beside `file`, then rename: readers get the old or the new content, and a full disk
    leaves no partial file.

    **Raises:** `OSError` with the name of the file.
    """
    beside = file.with_name(f".{file.name}.new")
    try:
        with beside.open("wb") as opened:
            opened.write(content)
            opened.flush()
            os.fsync(opened.fileno())
        beside.replace(file)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise type(error)(error.errno, error.strerror, str(file)) from error


AXIS = "time_axis"
"""The attribute of a store whose saved times are not called `time`, with their name."""


def time_axis(attributes: Mapping[str, Any]) -> str:
    """Return the name of the saved times of a store, by its attributes."""
    return str(attributes.get(AXIS, "time"))


def consolidate(path: Path, frames: int | None = None) -> None:
    """Replace the consolidated metadata of a store, which readers such as xarray use. With `frames`
    every array in it ends with the last complete frame, so that the store of a killed run opens."""
    group = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
    axis = time_axis(group.get("attributes", {}))
    about = {
        folder.name: json.loads((folder / "zarr.json").read_text(encoding="utf-8"))
        for folder in sorted(path.iterdir())
        if (folder / "zarr.json").is_file()
    }
    for each in about.values():
        if frames is not None and each.get("dimension_names", [None])[:1] == [axis]:
            each["shape"][0] = frames
    group["consolidated_metadata"] = {
        "kind": "inline", "must_understand": False, "metadata": about,
    }  # fmt: skip
    write_whole(path / "zarr.json", json.dumps(group).encode())
