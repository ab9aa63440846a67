"""The run directory: what a run leaves behind, readable at every moment.

    config.resolved.toml   every setting; running it again gives the same run
    manifest.json          versions, machine, data, constants, why it stopped
    summary.json           the model's headline figures
    log.jsonl              one JSON object an event
    trajectory.zarr        frames, as an xarray Dataset

Numbers that are not finite are the strings "inf", "-inf" and "nan" in JSON, which `float` reads.
Small files are replaced whole (written beside, then renamed). Frames are written into a store that
has its full length from the start; the time of a frame is written last and is NaN until then, so a
frame with a time is a frame that is complete, whatever killed the run.
"""

import json
import os
import platform
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from dvax.app.runs.json_numbers import json_ready

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
        text = json.dumps(json_ready(content), indent=2, ensure_ascii=False, allow_nan=False)
        write_whole(self.path / name, f"{text}\n".encode())

    def log(self, event: Mapping[str, Any]) -> None:
        """Append an event, with the moment it happened, and hand it to the system at once."""
        moment = datetime.now(UTC).isoformat(timespec="milliseconds")
        json.dump({"at": moment, **json_ready(event)}, self._log, ensure_ascii=False)
        self._log.write("\n")
        self._log.flush()

    def close(self) -> None:
        self._log.close()


def write_whole(file: Path, content: bytes) -> None:
    """Write beside `file`, then rename: a reader sees the old one or the new one, and where the disk is
    full nothing is left over.

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


def process() -> dict[str, Any]:
    """Which process a run is, for the manifest: whether it is still going on can be told from that."""
    return {"process": os.getpid(), "host": platform.node()}


def close_killed(directory: Path) -> bool:
    """Where the process of an unfinished run is gone, cut the frames off that it had not completed and
    say so in the manifest. Returns whether that was so."""
    file = directory / "manifest.json"
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False  # who reads the directory next says what is wrong with it
    ours = isinstance(manifest, dict) and manifest.get("status") == "running"
    if not ours or manifest.get("host") != platform.node() or _alive(manifest.get("process")):
        return False
    reason = "The process was killed, or the machine stopped; it left no word."
    write_whole(
        file,
        json.dumps(
            {**manifest, "status": "killed", "stop_reason": reason}, indent=2, ensure_ascii=False
        )
        + "\n",
    )
    store = directory / "trajectory.zarr"
    if store.is_dir():
        cut_incomplete(store)
    return True


def _alive(number: Any) -> bool:
    try:
        os.kill(int(number), 0)
    except (ProcessLookupError, TypeError, ValueError):
        return False
    except OSError:
        return True  # it is another user's
    return True


def cut_incomplete(path: Path) -> None:
    """Cut off the frames of a store without a time, which a killed run had not completed."""
    group = zarr.open_group(path, mode="r+", use_consolidated=False)
    if "time" not in group:
        return
    known = np.isfinite(np.asarray(group["time"][...]))  # pyright: ignore
    whole = len(known) if known.all() else int(np.argmin(known))
    for _, array in group.arrays():
        if getattr(array.metadata, "dimension_names", (None,))[:1] == ("time",):
            array.resize((whole, *array.shape[1:]))


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
        self._publish()

    def write(self, times: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        """Append complete frames; their times go last and make them count."""
        region = slice(self.written, self.written + len(times))
        for name, array in self._arrays.items():
            array[region] = values[name]
        self._time[region] = times
        self.written += len(times)
        self._publish()

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
        self._publish()

    def _publish(self) -> None:
        """Replace the group's consolidated metadata, which readers such as xarray take first: every
        array in it ends with the last complete frame, and so the store of a killed run opens."""
        about = {
            folder.name: json.loads((folder / "zarr.json").read_text(encoding="utf-8"))
            for folder in sorted(self.path.iterdir())
            if (folder / "zarr.json").is_file()
        }
        for each in about.values():
            if each.get("dimension_names", [None])[0] == "time":
                each["shape"][0] = self.written
        group = json.loads((self.path / "zarr.json").read_text(encoding="utf-8"))
        group["consolidated_metadata"] = {
            "kind": "inline", "must_understand": False, "metadata": about,
        }  # fmt: skip
        write_whole(self.path / "zarr.json", json.dumps(group).encode())
