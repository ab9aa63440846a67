"""Checkpoints of a run: states that it can go on from.

    checkpoints/step_000012/state.npz        arrays
    checkpoints/step_000012/MANIFEST.json    identity of the run, hashes, facts

A checkpoint is written into a folder beside, synchronised with the disk, and renamed: it is there as a
whole or not at all, whatever kills the process. Each file has its SHA-256 in the manifest, and the
manifest its own, so that a damaged one is recognised, named, and not used.
"""

import hashlib
import io
import json
import os
import re
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dvax.app.runs.json_files import json_ready
from dvax.errors import Problems

FOLDER = "checkpoints"
_NAME = re.compile(r"step_(\d+)")
_STATE, _MANIFEST, _BESIDE = "state.npz", "MANIFEST.json", ".new"


@dataclass(frozen=True)
class Checkpoint:
    """The number of a checkpoint, the file of its arrays, and facts about them."""

    number: int
    file: Path
    about: Mapping[str, Any]

    @property
    def arrays(self) -> list[np.ndarray]:
        """The arrays, read at each call: those of all checkpoints may not fit into the memory."""
        with np.load(self.file, allow_pickle=False) as arrays:
            return [arrays[f"arr_{k}"] for k in range(len(arrays.files))]


class Checkpoints:
    """The checkpoints of a run directory. `identity` says what must be the same for a run to go on:
    configuration, data and versions. They are due every so many `seconds`."""

    def __init__(self, directory: Path, identity: Mapping[str, str], seconds: float):
        self.folder = directory / FOLDER
        self.identity, self.seconds = dict(identity), seconds
        self.last = time.monotonic()

    def is_due(self) -> bool:
        return time.monotonic() - self.last >= self.seconds

    def save(self, number: int, arrays: Sequence[Any], about: Mapping[str, Any]) -> None:
        """Write a checkpoint. **Raises:** `OSError`, with the earlier ones intact."""
        content = io.BytesIO()
        np.savez(content, *map(np.asarray, arrays))
        state = content.getvalue()
        manifest = {
            "identity": self.identity,
            "files": {_STATE: hashlib.sha256(state).hexdigest()},
            "about": json_ready(about),
        }
        text = json.dumps({**manifest, "sha256": _digest(manifest)}, indent=1, allow_nan=False)
        place = self.folder / f"step_{number:06d}"
        beside = place.with_name(place.name + _BESIDE)
        shutil.rmtree(beside, ignore_errors=True)
        beside.mkdir(parents=True)
        for name, data in ((_STATE, state), (_MANIFEST, text.encode())):
            with (beside / name).open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        _synchronise(beside)
        shutil.rmtree(place, ignore_errors=True)
        beside.rename(place)
        _synchronise(self.folder)
        self.last = time.monotonic()

    def keep(self, count: int) -> None:
        """Remove all but the last `count` checkpoints."""
        for place in self._places()[:-count]:
            shutil.rmtree(place)

    def clear(self) -> None:
        """Remove all checkpoints."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def load(self) -> tuple[list[Checkpoint], list[str]]:
        """Return the checkpoints that are whole, in their order, and the files that are damaged.

        **Raises:** `dvax.InputError` where they are of a run of another identity.
        """
        found, damaged = [], []
        for beside in self.folder.glob(f"step_*{_BESIDE}"):
            shutil.rmtree(beside)
        for place in self._places():
            manifest, state = place / _MANIFEST, place / _STATE
            try:
                content = json.loads(manifest.read_text(encoding="utf-8"))
                if content.pop("sha256") != _digest(content):
                    raise ValueError
            except (OSError, ValueError, KeyError, AttributeError, TypeError):
                damaged.append(str(manifest))
                continue
            self._check(content["identity"])
            try:
                data = state.read_bytes()
            except OSError:
                data = b""
            if hashlib.sha256(data).hexdigest() != content["files"][_STATE]:
                damaged.append(str(state))
                continue
            found.append(Checkpoint(int(place.name[5:]), state, content["about"]))
        return found, damaged

    def _places(self) -> list[Path]:
        found = {int(m[1]): p for p in self.folder.glob("step_*") if (m := _NAME.fullmatch(p.name))}
        return [found[number] for number in sorted(found)]

    def _check(self, identity: Mapping[str, str]) -> None:
        problems = Problems()
        for name in sorted({*identity, *self.identity}):
            was, now = identity.get(name, "nothing"), self.identity.get(name, "nothing")
            if was != now:
                problems.add(
                    f"{self.folder.parent}: {name}", now, f"the run was made with {was}",
                    "Go on with what it was made with, or start a new run with dvax run",
                )  # fmt: skip
        problems.raise_any()


def _digest(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def _synchronise(folder: Path) -> None:
    """Let the names in a folder reach the disk, where the operating system can."""
    try:
        opened = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows opens no folders
        return
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
