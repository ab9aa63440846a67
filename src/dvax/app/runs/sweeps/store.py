"""sweep.zarr: the results of all members, as an xarray Dataset with a dimension `member`.

The creator writes the schema once. Chunks have one member each, so that members are written by
processes that know nothing of each other: separate chunks are safe, shared ones and metadata are not.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from dvax.app.runs.rundir import consolidate, new_store, replace_store
from dvax.app.runs.sweeps.parameters import Parameter
from dvax.errors import input_error

NAME = "sweep.zarr"
STATUS = ("missing", "finished", "failed", "interrupted")
"""The states of a member, by the numbers in the variable `status`."""

_MEMBER = "member"
_CHUNK_BYTES = 2**23
_OWN = "_of_member"


def create(
    directory: Path,
    parameters: Sequence[Parameter],
    results: "Results",
    variables: Sequence[str] | None,
    attributes: Mapping[str, Any],
) -> None:
    """Write an empty store for results like these, of all members; of the trajectory `variables`, by
    default all.

    **Raises:** `dvax.InputError` if there is no such variable.
    """
    count = len(parameters[0].values)
    for name in variables or ():
        if name not in results.arrays:
            raise input_error(
                "output.variables", repr(name), f"a run has {', '.join(sorted(results.arrays))}",
                "Correct the name, and pass --resume to go on",
            )  # fmt: skip
    coordinates: dict[str, Array] = {}
    for p in parameters:
        about = {"long_name": p.key, **({"units": p.unit} if p.unit else {})}
        coordinates[p.key] = Array((_MEMBER,), _coordinate(p), about)
    coordinates[_MEMBER] = Array(
        (_MEMBER,), np.arange(count), {"long_name": "number of the member"}
    )
    ofeach: dict[str, Array] = {
        "status": Array(
            (), np.int8(0),
            {"flag_values": list(range(len(STATUS))), "flag_meanings": " ".join(STATUS)},
        ),
        "steps": Array((), np.int64(0), {"long_name": "accepted steps", "units": "1"}),
    }  # fmt: skip
    for name, array in results.stored(variables).items():
        if array.dims == (name,):
            coordinates.setdefault(name, array)
            if array.values.dtype.kind == "f":
                ofeach[name + _OWN] = array
        elif array.values.dtype.kind in "fiub":
            ofeach[name] = array
    new = new_store(directory / NAME)
    group = zarr.open_group(
        new, mode="w-", zarr_format=3,
        attributes={"Conventions": "CF-1.11", **attributes, "coordinates": " ".join(coordinates)},
    )  # fmt: skip
    for name, array in coordinates.items():
        values = np.asarray(array.values)
        # Zarr's specification has texts of any length, and none of a fixed one.
        kind = "string" if values.dtype.kind == "U" else values.dtype
        new_array = group.create_array(
            name, shape=values.shape, dtype=kind, dimension_names=array.dims,
            attributes=dict(array.about),
        )  # fmt: skip
        new_array[...] = values
    for name, array in ofeach.items():
        values = np.asarray(array.values)
        integer = values.dtype.kind in "iub"
        group.create_array(
            name,
            shape=(count, *values.shape),
            chunks=(1, *_chunks(values)),
            dtype=values.dtype,
            fill_value=(0 if values.dtype.kind in "ub" or name in ("status", "steps") else -1)
            if integer
            else np.nan,
            dimension_names=(_MEMBER, *array.dims),
            attributes=dict(array.about),
        )
    consolidate(new)
    replace_store(new, directory / NAME)


def check_fit(directory: Path, parameters: Sequence[Parameter]) -> None:
    """Check that the members of a store are those of these parameters.

    **Raises:** `dvax.InputError`.
    """
    group: Any = zarr.open_group(directory / NAME, mode="r", use_consolidated=False)
    stored = {
        name: array[...]
        for name, array in group.arrays()
        if getattr(array.metadata, "dimension_names", None) == (_MEMBER,)
    }
    for p in parameters:
        values = _coordinate(p)
        if p.key not in stored or not np.array_equal(stored[p.key], values):
            raise input_error(
                f"{directory / NAME}: {p.key}", _line(values),
                f"the members of this sweep were made with {_line(stored.get(p.key))}",
                "Go on with the sweep file of the beginning, or give another folder with -o",
            )  # fmt: skip


def _coordinate(p: Parameter) -> np.ndarray:
    values = np.array(p.values if p.numbers is None else p.numbers)
    return values.astype(str) if values.dtype.kind == "O" else values


def _line(values: Any) -> str:
    return (
        "nothing"
        if values is None
        else f"{len(values)} values, {np.array2string(values, threshold=6)}"
    )


class Array:
    """Values with the names of their dimensions, and attributes."""

    def __init__(self, dims: tuple[str, ...], values: Any, about: Mapping[str, Any]):
        self.dims, self.values, self.about = dims, np.asarray(values), about


class Results:
    """The results of one member: the arrays of its trajectory, and its figures."""

    def __init__(self, folder: Path, summary: Mapping[str, Any]):
        self.arrays: dict[str, Array] = {}
        path = folder / "trajectory.zarr"
        if path.is_dir():
            group = zarr.open_group(path, mode="r", use_consolidated=False)
            for name, array in group.arrays():
                names = tuple(getattr(array.metadata, "dimension_names", None) or ())
                about = {k: v for k, v in array.attrs.items() if k != "status"}
                self.arrays[name] = Array(names, array[...], about)
        self.figures: dict[str, Array] = {}
        for name, entry in summary.items():
            values = _numbers(entry["value"])
            if values is None:
                continue
            key = name if name not in self.arrays else f"summary_{name}"
            dims = tuple(f"{key}_{k}" for k in range(values.ndim))
            about = {"long_name": entry["meaning"], "units": entry["unit"] or "1"}
            self.figures[key] = Array(dims, values, about)

    def stored(self, variables: Sequence[str] | None) -> dict[str, Array]:
        """Return the figures and the chosen variables, with the coordinates of their dimensions."""
        chosen = {n: a for n, a in self.arrays.items() if variables is None or n in variables}
        dims = {d for array in chosen.values() for d in array.dims}
        chosen |= {n: a for n, a in self.arrays.items() if n in dims}
        return {**chosen, **self.figures}


def write_member(
    directory: Path, member: int, results: Results, variables: Sequence[str] | None, steps: int
) -> list[str]:
    """Write the results of a member, its status last. Returns the names of those that do not fit into
    the store, because their shape is another one."""
    group: Any = zarr.open_group(directory / NAME, mode="r+", use_consolidated=False)
    unfit = []
    for name, array in results.stored(variables).items():
        key = name + _OWN if array.dims == (name,) else name
        if key not in group:
            if array.dims != (name,) and array.values.dtype.kind in "fiub":
                unfit.append(name)
            continue
        target = group[key]
        if target.shape[1:] != array.values.shape:
            unfit.append(name)
        else:
            target[member] = array.values
    group["steps"][member] = steps
    mark_member(directory, member, "finished")
    return unfit


def mark_member(directory: Path, member: int, status: str) -> None:
    """Write the status of a member."""
    group: Any = zarr.open_group(directory / NAME, mode="r+", use_consolidated=False)
    group["status"][member] = STATUS.index(status)


def _chunks(values: np.ndarray) -> tuple[int, ...]:
    """Return chunks of at most 8 MB: whole rows of the first axis, where they are short enough."""
    if not values.ndim:
        return ()
    row = values[0].nbytes or 1
    first = min(max(len(values), 1), max(1, _CHUNK_BYTES // row))
    rest = [max(1, n) for n in values.shape[1:]]
    if row > _CHUNK_BYTES and rest:
        rest[-1] = max(1, rest[-1] * _CHUNK_BYTES // row)
    return first, *rest


def _numbers(value: Any) -> np.ndarray | None:
    """Return a figure as an array of floats; None where it is a text."""
    try:
        # Non-finite numbers are texts in JSON.
        return np.asarray(value, dtype=object).astype(float)
    except (TypeError, ValueError):
        return None
