"""trajectory.zarr as pictures read it: variables by name, a part at a time, whole frames alone.

Read by zarr and not by xarray, whose import (with pandas) takes longer than the pictures.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr


class Frames:
    """The first `count` frames of a store of variables over (time,), (point,) or (time, point)."""

    def __init__(self, group: zarr.Group, count: int):
        self.count = count
        self.attrs: Mapping[str, Any] = group.attrs.asdict()
        self._arrays: dict[str, Any] = dict(group.arrays())
        self._read: dict[str, np.ndarray] = {}

    def __contains__(self, name: object) -> bool:
        return name in self._arrays

    @property
    def points(self) -> int:
        """The number of points on the boundary."""
        return int(self._arrays["pressure"].shape[1])

    @property
    def frames_per_chunk(self) -> int:
        """How many frames of a field are stored, and so read, as one."""
        return int(self._arrays["pressure"].chunks[0])

    def line(self, name: str) -> np.ndarray:
        """A variable over time or over the points alone. Read once: it may lie in many chunks."""
        if name not in self._read:
            array = self._arrays[name]
            over_time = array.metadata.dimension_names == ("time",)
            self._read[name] = np.asarray(array[: self.count] if over_time else array[:])
        return self._read[name]

    def field(self, name: str, frames: slice | int) -> np.ndarray:
        """A variable over time and points, at these frames; they lie below `count`."""
        return np.asarray(self._arrays[name][frames])

    def about(self, name: str) -> Mapping[str, Any]:
        """The attributes of a variable: `units`, `long_name`, for a bound its `status`."""
        return self._arrays[name].attrs.asdict()


def open_frames(store: Path) -> tuple[Frames | None, int]:
    """The frames that are whole (None where there is none), and how many there is room for.

    A store has its full length from the start, and a frame gets its time when it is complete.
    Raises `OSError`, `ValueError` or `KeyError` where it is damaged.
    """
    group = zarr.open_group(store, mode="r")
    if "time" not in group:
        return None, 0
    time = np.asarray(group["time"][:], dtype=float)  # pyright: ignore[reportArgumentType]
    if time.size == 0:
        return None, 0
    rising = np.isfinite(time) & np.concatenate([[True], np.diff(time) > 0])
    whole = len(time) if rising.all() else int(np.argmin(rising))
    return (Frames(group, whole) if whole else None), len(time)
