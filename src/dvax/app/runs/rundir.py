"""The run directory: the files of a run, readable at every moment.

    config.resolved.toml   every setting; running it again gives the same run
    manifest.json          versions, machine, data, constants, why it stopped
    summary.json           the model's headline figures
    log.jsonl              one JSON object an event
    trajectory.zarr        frames, as an xarray Dataset
    checkpoints            states that an unfinished run can go on from

Numbers that are not finite are the strings "inf", "-inf" and "nan" in JSON, which `float` reads.
Small files are replaced atomically (written beside, then renamed). Frames are written into a store that
has its full length from the start; the time of a frame is written last and is NaN until then, so a
frame with a time is complete, whatever killed the run.
"""

import hashlib
import json
import math
import os
import platform
import shutil
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from dvax._files import AXIS
from dvax._files import consolidate as consolidate
from dvax._files import write_whole as write_whole
from dvax.app.runs import checkpoints
from dvax.app.runs.json_files import json_ready, read_object
from dvax.app.runs.lock import NAME as LOCK
from dvax.app.runs.lock import lock
from dvax.errors import Problems

FILES = ("config.resolved.toml", "manifest.json", "summary.json", "log.jsonl", "report.html")
FOLDERS = (
    "trajectory.zarr", ".trajectory.zarr.new", ".trajectory.zarr.old", "figures", "inputs",
    checkpoints.FOLDER,
)  # fmt: skip
_CHUNK_BYTES = 2**23


class RunDirectory:
    """A folder that a run writes into. `clear` removes what a former run left there, nothing else."""

    def __init__(self, path: Path, *, clear: bool):
        self.path = path
        path.mkdir(parents=True, exist_ok=True)
        self._lock = lock(path)
        if clear:
            for name in (*_further_files(path / "manifest.json"), *FILES):
                (path / name).unlink(missing_ok=True)
            for name in FOLDERS:
                if (path / name).exists():
                    shutil.rmtree(path / name)
        self.lost = 0 if clear else _repair(path / "log.jsonl")
        """Lines of the log that were damaged, and removed."""
        self._log = (path / "log.jsonl").open("a", encoding="utf-8")

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Replace a small file atomically."""
        write_json(self.path / name, content)

    def log(self, event: Mapping[str, Any]) -> None:
        """Append an event with its time of day, and flush."""
        moment = datetime.now(UTC).isoformat(timespec="milliseconds")
        json.dump({"at": moment, **json_ready(event)}, self._log, ensure_ascii=False)
        self._log.write("\n")
        self._log.flush()

    def title(self) -> str:
        """Return the title in the manifest, "" if there is none."""
        return str(read_object(self.path / "manifest.json").get("title", ""))

    def close(self) -> None:
        self._log.close()
        self._lock.close()


def _further_files(manifest: Path) -> list[str]:
    """Return the files that the model of a run wrote, by its manifest."""
    names = read_object(manifest).get("files")
    names = names if isinstance(names, list) else []
    return [name for name in names if isinstance(name, str) and name == Path(name).name]


def _repair(log: Path) -> int:
    """Remove the lines of a log that are no JSON, and return their number."""
    if not log.is_file():
        return 0
    kept, lines = [], log.read_bytes().splitlines()
    for line in lines:
        try:
            json.loads(line.decode())
            kept.append(line)
        except ValueError:
            pass
    if len(kept) < len(lines):
        write_whole(log, b"".join(line + b"\n" for line in kept))
    return len(lines) - len(kept)


def write_json(file: Path, content: Mapping[str, Any]) -> None:
    """Write an object; numbers that are not finite become strings. Raises `OSError`."""
    text = json.dumps(json_ready(content), indent=2, ensure_ascii=False, allow_nan=False)
    write_whole(file, f"{text}\n".encode())


def process() -> dict[str, Any]:
    """Return process id and host for the manifest, by which `close_killed` decides whether it still
    runs."""
    return {"process": os.getpid(), "host": platform.node()}


def close_killed(directory: Path) -> bool:
    """Record it in the manifest if the process of a run was killed. Returns whether that was so."""
    file = directory / "manifest.json"
    manifest = read_object(file)
    ours = manifest.get("status") == "running" and manifest.get("host") == platform.node()
    if not ours or _alive(manifest.get("process")):
        return False
    reason = "The process was killed, or the machine stopped; it left no word."
    write_json(file, {**manifest, "status": "killed", "stop_reason": reason})
    return True


def _alive(number: Any) -> bool:
    try:
        os.kill(int(number), 0)
    except (ProcessLookupError, TypeError, ValueError):
        return False
    except OSError:
        return True  # the process of another user
    return True


class FrameStore:
    """trajectory.zarr: variables over time, of which the first `written` frames are complete.

    `coords` are complete from the start, and `sizes` are the lengths of dimensions that none of them
    has. `axis` is the name of the saved times."""

    def __init__(
        self,
        path: Path,
        frames: int,
        block: int,
        coords: Mapping[str, tuple[tuple[str, ...], np.ndarray, dict[str, Any]]],
        variables: Mapping[str, tuple[tuple[str, ...], Any, dict[str, Any]]],
        attrs: Mapping[str, Any],
        time_attrs: Mapping[str, Any],
        *,
        axis: str = "time",
        sizes: Mapping[str, int] | None = None,
    ):
        self.path, self.axis = path, axis
        self.written = 0
        lengths = {
            d: n for dims, v, _ in coords.values() for d, n in zip(dims, v.shape, strict=True)
        }
        lengths |= {**(sizes or {}), axis: frames}
        # Written by zarr alone: importing xarray takes longer than solving a block. To read a Dataset
        # xarray needs the names of the dimensions, and this attribute for its coordinates.
        group = zarr.open_group(
            path,
            mode="w-",
            zarr_format=3,
            attributes={
                "coordinates": " ".join(coords),
                **({} if axis == "time" else {AXIS: axis}),
                **attrs,
            },
        )

        def chunks(dims: tuple[str, ...]) -> tuple[int, ...]:
            shape = [block if d == axis else max(1, lengths[d]) for d in dims]
            if dims and dims != (axis,):
                before = block * math.prod(n for d, n in zip(dims, shape, strict=True) if d != axis)
                most = _CHUNK_BYTES * shape[-1] // (8 * before)
                shape[-1] = max(1, min(shape[-1], most))
            return tuple(shape)

        def create(name: str, dims: tuple[str, ...], dtype: Any, meta: Mapping[str, Any]) -> Any:
            integer = np.issubdtype(dtype, np.integer)
            fill = False if np.dtype(dtype).kind == "b" else -1 if integer else np.nan
            return group.create_array(
                name,
                shape=tuple(lengths[d] for d in dims),
                chunks=chunks(dims),
                dtype=dtype,
                fill_value=fill,
                dimension_names=dims,
                attributes=dict(meta),
            )

        self._fixed = {n: create(n, dims, v.dtype, meta) for n, (dims, v, meta) in coords.items()}
        self.put({name: values for name, (_, values, _) in coords.items()})
        self._time = create(axis, (axis,), np.float64, time_attrs)
        self._arrays = {name: create(name, *variable) for name, variable in variables.items()}
        self._hashes: dict[str, str] = {}
        self._publish()

    def copy_frames(self, other: Path, written: int, hashes: Mapping[str, str]) -> None:
        """Take over the first `written` frames of another store, in these files. Its metadata are not
        used: they have no hashes."""
        for name in hashes:
            target = self.path / name
            if not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(other / name, target)
        self.written, self._hashes = written, dict(hashes)
        self._publish()

    def move(self, path: Path) -> None:
        """Put the store in the place of the one at `path`."""
        replace_store(self.path, path)
        self.path = path
        group: Any = zarr.open_group(path, mode="r+", use_consolidated=False)
        self._time = group[self.axis]
        self._arrays = {name: group[name] for name in self._arrays}
        self._fixed = {name: group[name] for name in self._fixed}

    def put(self, fixed: Mapping[str, np.ndarray]) -> None:
        """Replace values of variables without a time axis."""
        for name, values in fixed.items():
            self._fixed[name][...] = values

    def series(self) -> "Series":
        """Return the variables over time of the complete frames, each read when it is asked for."""
        return Series({self.axis: self._time, **self._arrays}, self.written)

    def read(self, frames: slice) -> dict[str, np.ndarray]:
        """Return the variables of some frames."""
        stop = min(frames.stop, self.written)
        return {name: np.asarray(a[frames.start : stop]) for name, a in self._arrays.items()}

    def files(self, frames: int) -> dict[str, str]:
        """Return the SHA-256 of every file of values, of the arrays over time up to the complete chunks
        of the first `frames`. Each is read once."""
        over_time = {self.axis: self._time, **self._arrays}
        for file in sorted(self.path.rglob("c/**/*")):
            name = file.relative_to(self.path)
            if not file.is_file() or str(name) in self._hashes:
                continue
            array = over_time.get(name.parts[0])
            # c/<chunk of time>/…: the chunk behind a failed block is not complete.
            if array is None or (int(name.parts[2]) + 1) * array.chunks[0] <= frames:
                self._hashes[str(name)] = _sha256(file)
        return dict(self._hashes)

    def write(self, times: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        """Append complete frames; their times are written last."""
        region = slice(self.written, self.written + len(times))
        for name, array in self._arrays.items():
            array[region] = values[name]
        self._time[region] = times
        self.written += len(times)
        self._publish()

    def mark(self, names: tuple[str, ...], status: str) -> None:
        """Set the attribute `status` of these variables: proved, declared or estimated."""
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
        consolidate(self.path, self.written)


class Series(Mapping[str, np.ndarray]):
    """Variables over time that lie in a store, in the memory only while they are used."""

    def __init__(self, arrays: Mapping[str, Any], count: int):
        self._arrays, self._count = arrays, count

    def __getitem__(self, name: str) -> np.ndarray:
        return np.asarray(self._arrays[name][: self._count])

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)


def damaged_files(path: Path, hashes: Mapping[str, str]) -> str | None:
    """Return the first file of a store whose SHA-256 is not this one, None if all are."""
    for name, known in hashes.items():
        file = path / name
        try:
            if _sha256(file) != known:
                return str(file)
        except OSError:
            return str(file)
    return None


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def new_store(path: Path) -> Path:
    """Return the path of a new store that will replace the one at `path`."""
    new = path.with_name(f".{path.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    return new


def replace_store(new: Path, path: Path) -> None:
    """Rename a complete store to `path`, in the place of the one there."""
    old = path.with_name(f".{path.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if path.exists():
        path.rename(old)
    new.rename(path)
    shutil.rmtree(old, ignore_errors=True)


def recover_store(path: Path) -> None:
    """Complete `replace_store` if a process was killed between its two renames."""
    new = path.with_name(f".{path.name}.new")
    if not path.exists() and new.exists():
        new.rename(path)


def _has_only_files_of_a_run(out: Path) -> bool:
    """Return whether a folder holds only what a run writes before its manifest."""
    return {file.name for file in out.iterdir()} <= {*FILES, *FOLDERS, LOCK}


def target_problems(out: Path, *, force: bool) -> Problems:
    """Return the reasons not to write a run into `out`: existing files are kept, unless the user asks
    otherwise."""
    problems = Problems()
    if out.exists() and not out.is_dir():
        fix = "Give the name of a folder that does not exist yet."
        problems.add(str(out), "a file", "results are written into a folder", fix)
    elif out.exists() and any(file.name != LOCK for file in out.iterdir()):
        if not force:
            problems.add(
                str(out),
                "a folder that is not empty",
                "results are never written over others unasked",
                "Give another folder, or --force to replace what dvax wrote here.",
            )
        elif not (out / "manifest.json").is_file() and not _has_only_files_of_a_run(out):
            problems.add(
                str(out),
                "a folder that is not empty and holds no manifest.json",
                "--force replaces a run of dvax and deletes nothing else",
                "Give another folder, or empty this one yourself.",
            )
    return problems
