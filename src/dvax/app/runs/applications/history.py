"""Measured histories of an application: columns of a CSV file over its column of times."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dvax.app.runs.schema_errors import unknown_key
from dvax.app.runs.units import in_unit
from dvax.errors import InputError, input_error
from dvax.formats.csv_columns import Column, check_increasing, column_names, read_columns

TIME = "time"


class History(NamedTuple):
    """Increasing times (m,), the values (m,) of each column, and the unit of time in the file."""

    times: np.ndarray
    columns: Mapping[str, np.ndarray]
    unit: str

    def check_covers(self, path: Path, t_end: float, unit: str) -> "History":
        """Return the history, or raise an `InputError` unless it covers the run from 0 to `t_end`."""
        first, last = float(self.times[0]), float(self.times[-1])
        if first > 0.0 or last < t_end:
            header = "" if self.unit == unit else f" ({TIME} [{self.unit}] in the first row)"
            raise input_error(
                path.name, f"times from {first:g} to {last:g} {unit}{header}",
                f"it covers the run, from 0 to {t_end:g} {unit}: nothing is extrapolated",
                "Add rows, shorten the run, or correct the unit of the times",
            )  # fmt: skip
        return self


def read_history(path: Path, units: Mapping[str, str], time_unit: str) -> History:
    """Return the columns of a file, each of which is one of `units`, in that unit.

    **Raises:** `dvax.InputError` for other columns, and everything that is wrong in the file.
    """
    names = [name for name in column_names(path) if name != TIME]
    unknown = [name for name in names if name not in units]
    if unknown:
        problems = (unknown_key(path.name, n, f"column {n}", [TIME, *units]) for n in unknown)
        raise InputError(*problems)
    return _history(path, read_columns(path, [TIME, *names], TIME), units, time_unit)


def read_series(path: Path, name: str, unit: str, time_unit: str) -> History:
    """Return the column `name` of a file in this unit, or the only one besides the times.

    **Raises:** `dvax.InputError` with everything that is wrong in the file.
    """
    wanted = name if name in column_names(path) else None
    choose = f'Call the column that is meant {name!r}, as in "{name} [{unit}]"'
    time, column = read_columns(path, [TIME, wanted], TIME, choose)
    found = _history(path, [time, column], {column.name: unit}, time_unit)
    return found._replace(columns={name: found.columns[column.name]})


def _history(
    path: Path, columns: list[Column], units: Mapping[str, str], time_unit: str
) -> History:
    time, *others = columns
    check_increasing(path.name, time)
    if len(time.values) < 2:
        raise input_error(
            path.name, "one row", "a history has two rows at least", "Add the last time of the run"
        )
    times = in_unit(path.name, time, time_unit)
    found = {c.name: in_unit(path.name, c, units[c.name] or "1") for c in others}
    return History(times, found, time.unit)
