"""The run directory: what a run leaves behind, readable at every moment.

    config.resolved.toml   every setting; running it again gives the same run
    manifest.json          versions, machine, data, constants, why it stopped
    summary.json           the model's headline figures
    log.jsonl              one JSON object an event
    trajectory.zarr        frames, as an xarray Dataset

Small files are replaced whole (written beside, then renamed). Frames are written into a store that
has its full length from the start; the time of a frame is written last and is NaN until then, so a
frame with a time is a frame that is complete, whatever killed the run.
"""

import json
import os
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import zarr

FILES = (
    "config.resolved.toml", "manifest.json", "summary.json", "log.jsonl", "report.html",
    "body.vtu", "body-contact.vtu",
)  # fmt: skip
FOLDERS = ("trajectory.zarr", "figures", "inputs")
_CHUNK_BYTES = 2**23


class RunDirectory:
    """A folder that a run writes into. `clear` removes what a former run left there, nothing else."""

    def __init__(self, path: Path, *, clear: bool):
        self.path = path
        path.mkdir(parents=True, exist_ok=True)
        if clear:
            for name in FILES:
                (path / name).unlink(missing_ok=True)
            for name in FOLDERS:
                if (path / name).exists():
                    shutil.rmtree(path / name)
        self._log = (path / "log.jsonl").open("a", encoding="utf-8")

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Replace a small file as a whole: a reader sees the old one or the new one."""
        beside = self.path / f".{name}.new"
        with beside.open("w", encoding="utf-8") as file:
            json.dump(content, file, indent=2, ensure_ascii=False, allow_nan=False)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        beside.replace(self.path / name)

    def log(self, event: Mapping[str, Any]) -> None:
        """Append an event, with the moment it happened, and hand it to the system at once."""
        moment = datetime.now(UTC).isoformat(timespec="milliseconds")
        json.dump({"at": moment, **event}, self._log, ensure_ascii=False)
        self._log.write("\n")
        self._log.flush()

    def close(self) -> None:
        self._log.close()


class FrameStore:
    """trajectory.zarr: variables over time, of which the first `written` frames are complete."""

    def __init__(
        self,
        path: Path,
        frames: int,
        block: int,
        coords: Mapping[str, tuple[tuple[str, ...], np.ndarray, dict[str, Any]]],
        variables: Mapping[str, tuple[tuple[str, ...], Any, dict[str, Any]]],
        attrs: Mapping[str, Any],
        time_attrs: Mapping[str, Any],
    ):
        self.path = path
        self.written = 0
        points = next(len(values) for dims, values, _ in coords.values() if dims == ("point",))
        sizes = {"time": frames, "point": points}
        chunk = {"time": block, "point": min(points, max(1, _CHUNK_BYTES // (8 * block)))}
        # Written by zarr alone: xarray takes longer to import than a block to solve. What it needs
        # to see a Dataset is the names of the dimensions, and this attribute for its coordinates.
        group = zarr.open_group(
            path,
            mode="w-",
            zarr_format=3,
            attributes={**attrs, "coordinates": " ".join(coords)},
        )

        def create(name: str, dims: tuple[str, ...], dtype: Any, meta: Mapping[str, Any]) -> Any:
            integer = np.issubdtype(dtype, np.integer)
            return group.create_array(
                name,
                shape=tuple(sizes[d] for d in dims),
                chunks=tuple(chunk[d] for d in dims),
                dtype=dtype,
                fill_value=-1 if integer else np.nan,
                dimension_names=dims,
                attributes=dict(meta),
            )

        for name, (dims, values, meta) in coords.items():
            create(name, dims, values.dtype, meta)[...] = values
        self._time = create("time", ("time",), np.float64, time_attrs)
        self._arrays = {name: create(name, *variable) for name, variable in variables.items()}

    def write(self, times: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        """Append complete frames; their times go last and make them count."""
        region = slice(self.written, self.written + len(times))
        for name, array in self._arrays.items():
            array[region] = values[name]
        self._time[region] = times
        self.written += len(times)

    def mark(self, names: tuple[str, ...], status: str) -> None:
        """State how much is known of these variables (their attribute `status`)."""
        for name in names:
            attrs = self._arrays[name].attrs
            if attrs.get("status") != status:
                attrs["status"] = status

    def finish(self) -> None:
        """Cut off the frames that were never reached."""
        for array in (self._time, *self._arrays.values()):
            if array.shape[0] != self.written:
                array.resize((self.written, *array.shape[1:]))
