"""Measured factors of a field: histories in time and profiles over the boundary, in working
units."""

import io
import math
import tokenize
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvax.app.runs.boundary import Boundary
from dvax.app.runs.schema import ProfileSection, SeriesSection
from dvax.app.runs.units import Units
from dvax.errors import Problems, input_error
from dvax.formats.at2 import read_at2
from dvax.formats.csv_columns import Column, check_increasing, read_columns
from dvax.formats.table import read_bytes

# What numpy raises for broken headers and data, errors of its tokenizer included.
_BROKEN_NPY = (
    ValueError,
    TypeError,
    SyntaxError,
    KeyError,
    EOFError,
    OSError,
    MemoryError,
    OverflowError,
    RecursionError,
    tokenize.TokenError,
    Warning,
)
_CUBIC_LEAST = 4  # points that a not-a-knot spline needs


@dataclass(frozen=True)
class Series:
    """Values (m,) at increasing times (m,) [unit of time], joined as `kind` says.

    `carries_unit`: the values are quantities and no pure numbers.
    """

    times: np.ndarray
    values: np.ndarray
    kind: str
    carries_unit: bool


@dataclass(frozen=True)
class Profile:
    """One value for each point of the boundary."""

    values: np.ndarray
    carries_unit: bool


def read_series(
    section: SeriesSection, path: Path, units: Units, kind: str, end: float, place: str
) -> Series:
    """Read a history that covers [0, end]; `kind` is the quantity of the field.

    Raises `InputError`, also where the data would have to be extrapolated.
    """
    factor = section.per_unit if isinstance(section.per_unit, float) else None
    if path.suffix.lower() == ".at2":
        step, raw = read_at2(path)
        problems = Problems()
        for key, value in (("column", section.column), ("time_column", section.time_column)):
            if value not in (None, "time"):
                rule = "an .at2 record has no columns"
                problems.add(f"{place}.{key}", repr(value), rule, "Remove it.")
        if factor is None:
            problems.add(
                f"{place}.per_unit",
                "nothing",
                f"an .at2 record is in g, which is no {kind}",
                f'Say what 1 g stands for: per_unit = "30 {units.of(kind)}".',
            )
        problems.raise_any()
        times = step * np.arange(raw.size) * units.factor("s", "time")
        values, carries_unit = raw * factor, True
    else:
        time, column = read_columns(
            path, [section.time_column, section.column], section.time_column
        )
        check_increasing(path.name, time)
        times = units.values(path.name, time, "time")
        values, carries_unit = _scaled(path.name, column, factor, units, kind)
    least = _CUBIC_LEAST if section.kind == "cubic" else 2
    if times.size < least:
        raise input_error(
            path.name,
            f"{times.size} rows",
            f"a {section.kind} history needs {least} of them at least",
            "Add measurements.",
        )
    # The last time of a table in other units may miss `end` by a rounding error of the conversion.
    slack = 1e-12 * abs(times[-1])
    if times[0] > 0 or times[-1] < end - slack:
        raise input_error(
            place,
            f"{path.name} from {times[0]:.12g} to {times[-1]:.12g} {units.time}",
            f"the data covers the run from 0 to {end:.12g} {units.time}: nothing is extrapolated",
            "Shorten time.end, or measure for longer.",
        )
    if times[-1] < end:
        times = np.append(times[:-1], end)
    return Series(times, values, section.kind, carries_unit)


def read_profile(
    section: ProfileSection, path: Path, units: Units, kind: str, boundary: Boundary, place: str
) -> Profile:
    """A profile on the points of the boundary: NPY point by point, CSV interpolated by straight
    lines.

    Raises `InputError` where lengths differ or the coordinates do not cover the boundary's points.
    """
    factor = section.per_unit if isinstance(section.per_unit, float) else None
    if path.suffix.lower() == ".npy":
        values = read_npy(section, path, boundary.shape, place)
        return Profile(values * (1.0 if factor is None else factor), factor is not None)
    points = boundary.coordinates[0]
    if len(boundary.coordinates) > 1:
        raise input_error(
            f"{place}.file",
            repr(section.file),
            "a profile over a rectangle is an NPY array",
            f"Save it with the shape {boundary.shape}.",
        )
    position, column = read_columns(
        path, [section.position_column, section.column], section.position_column
    )
    check_increasing(path.name, position)
    s = units.values(path.name, position, "length")
    slack = 1e-12 * np.max(np.abs(s))
    if s[0] > points.min() + slack or s[-1] < points.max() - slack:
        raise input_error(
            place,
            f"{path.name} from {s[0]:.12g} to {s[-1]:.12g} {units.length}",
            f"it covers the points from {points.min():.12g} to {points.max():.12g} {units.length}: "
            "nothing is extrapolated",
            "Shorten the boundary, or measure further.",
        )
    values, carries_unit = _scaled(path.name, column, factor, units, kind)
    return Profile(np.interp(points, s, values), carries_unit)


def read_npy(section: ProfileSection, path: Path, shape: tuple[int, ...], place: str) -> np.ndarray:
    """The values of an NPY profile on a boundary of this shape. Raises `InputError`."""
    for key, value in (("column", section.column), ("position_column", section.position_column)):
        if value not in (None, "s"):
            raise input_error(
                f"{place}.{key}", repr(value), "an NPY file has no columns", "Remove it."
            )
    content = read_bytes(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # numpy repairs some headers with a mere warning
            array = _array(content)
    except _BROKEN_NPY as e:
        raise input_error(
            path.name,
            str(e).splitlines()[0][:120] if str(e) else "an incomplete file",
            "a profile is an NPY file with an array of numbers, without pickled objects",
            "Save it with numpy.save(name, array.astype(float)).",
        ) from None
    if array.dtype.kind not in "fiu":
        rule = "a profile is one array of real numbers"
        raise input_error(path.name, str(array.dtype)[:120], rule, "Save it as float.")
    size = math.prod(shape)
    if array.shape not in {(size,), shape}:
        raise input_error(
            f"{place}.file",
            f"{path.name} with {array.size} values (shape {array.shape})",
            f"the boundary has {size} points (shape {shape}), a value for each",
            "Set boundary.points to the profile's length, or resample the profile.",
        )
    with np.errstate(over="ignore"):  # of longer numbers; infinities are refused below
        values = array.astype(np.float64).ravel()
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        first = int(bad[0])
        raise input_error(
            f"{path.name}, value {first + 1}",
            f"{values[first]} ({bad.size} such values)",
            "every value of a profile is finite: a gap is not a value",
            "Fill the gaps on purpose.",
        )
    return values


def _array(content: bytes) -> np.ndarray:
    """Return the array of an NPY file without a copy. The bytes behind the header are numbers and never
    pickled objects, and there must be as many as the shape needs: nothing of that size is allocated."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    headers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    shape, is_fortran, dtype = headers[version](stream)
    if min(shape, default=0) < 0:
        raise ValueError(f"the shape {shape}")
    numbers = np.frombuffer(content, dtype, math.prod(shape), stream.tell())
    return numbers.reshape(shape, order="F" if is_fortran else "C")


def _scaled(
    file: str, column: Column, per_unit: float | None, units: Units, kind: str
) -> tuple[np.ndarray, bool]:
    """Return the values of a column in working units, and whether they are more than pure numbers."""
    if per_unit is not None:
        return column.values * per_unit, True
    if column.unit == "1":
        return column.values, False
    return units.values(file, column, kind), True
