"""Read trajectory.zarr lazily, variable by variable.

By zarr and not by xarray, whose import (with pandas) takes longer than drawing the pictures.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import zarr

from dvax._files import time_axis


class _InMemory:
    """Values with the attributes of an array of zarr."""

    def __init__(self, values: np.ndarray, attrs: Mapping[str, Any], dims: tuple[str, ...]):
        self.shape, self.dtype, self.chunks = values.shape, values.dtype, values.shape
        self.attrs = SimpleNamespace(asdict=lambda: attrs)
        self.metadata = SimpleNamespace(dimension_names=dims)
        self._values = values

    def __getitem__(self, which: Any) -> np.ndarray:
        return self._values[which]


class Variable:
    """An array of the store: its first `count` frames where it depends on time, else all of it.

    `dims`, `shape` and `dtype` are those of these values, `attrs` the attributes.
    """

    def __init__(self, array: Any, count: int | None, axis: str = "time"):
        self._array, self._count, self._axis = array, count, axis
        self.attrs: Mapping[str, Any] = array.attrs.asdict()
        self.unit = str(self.attrs.get("units", ""))
        self.status = str(self.attrs.get("status", ""))
        """How much is known of a bound: proved, declared or estimated."""
        self.dims: tuple[str, ...] = tuple(array.metadata.dimension_names or ())
        self.dtype: np.dtype = array.dtype
        self.shape: tuple[int, ...] = tuple(array.shape)
        if self.dims[:1] == (axis,) and count is not None:
            self.shape = (count, *self.shape[1:])

    @cached_property
    def values(self) -> np.ndarray:
        """All values. Read once: they may lie in many chunks."""
        over_time = self.dims[:1] == (self._axis,)
        return np.asarray(self._array[: self._count] if over_time else self._array[...])

    def frames(self, which: slice | int) -> np.ndarray:
        """The values at some frames, which lie below `count`."""
        return np.asarray(self._array[which])

    @classmethod
    def of(cls, values: np.ndarray, dims: tuple[str, ...], attrs: Mapping[str, Any]) -> "Variable":
        """Return a variable whose values are in memory."""
        return cls(_InMemory(values, attrs, dims), None)

    @property
    def points(self) -> int:
        """The length of the last dimension."""
        return int(self._array.shape[-1])

    @property
    def frames_per_chunk(self) -> int:
        """How many frames are stored, and so read, as one."""
        return int(self._array.chunks[0])


@dataclass(frozen=True)
class Store:
    """The variables of a run by name, and the attributes of the dataset. `count` is the number of
    frames that are whole; None where no variable has the saved times."""

    attrs: Mapping[str, Any]
    variables: Mapping[str, Variable]
    count: int | None


def open_store(path: Path) -> tuple[Store, int]:
    """The store of a run, and how many frames there is room for.

    A store has its full length from the start, and a frame gets its time when it is complete.
    Raises `OSError`, `ValueError` or `KeyError` where it is damaged.
    """
    group = zarr.open_group(path, mode="r")
    arrays = dict(group.arrays())
    count, room, axis = None, 0, time_axis(group.attrs.asdict())
    if axis in arrays:
        time = np.asarray(arrays[axis][:], dtype=float)
        increasing = np.isfinite(time) & (np.diff(time, prepend=-np.inf) > 0)
        room = len(time)
        count = room if increasing.all() else int(np.argmin(increasing))
    order: Any = group.attrs.asdict().get("variable_order", [])
    names = [name for name in order if name in arrays]
    names += [name for name in arrays if name not in names]
    variables = {name: Variable(arrays[name], count, axis) for name in names}
    return Store(group.attrs.asdict(), variables, count), room
