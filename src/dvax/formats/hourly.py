"""Tables of an hourly record: CSV files with a row an hour, checked cell by cell."""

import csv
import datetime
import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputError, InputProblem

MAX_PROBLEMS = 20
"""Flaws reported of one file: a shifted column alone would make thousands."""

_CLOCK = ("Year", "Month", "Day", "Period")


class Rows(NamedTuple):
    """A CSV file: the names of its columns, and for every other row its line and its cells."""

    file: str
    names: list[str]
    rows: list[tuple[int, list[str]]]

    def column(self, name: str) -> int:
        return self.names.index(name)


class Hourly(NamedTuple):
    """Numbers by hour: `start`, the first hour; `names` of the columns; `values`, a row an hour;
    `lines` of the file that the rows stand on."""

    file: str
    start: datetime.datetime
    names: list[str]
    values: np.ndarray
    lines: list[int]


def read_rows(path: Path, wanted: tuple[str, ...], problems: list[InputProblem]) -> Rows | None:
    """The rows of a CSV file that has the `wanted` columns; None, and what is wrong, where not."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        problems.append(
            InputProblem(path.name, f"{error}", "it must be a readable text file in UTF-8",
                         "Check the folder, the permissions and the encoding")
        )  # fmt: skip
        return None
    table = [(k, row) for k, row in enumerate(csv.reader(text.splitlines()), 1) if any(row)]
    if len(table) < 2:
        problems.append(
            InputProblem(path.name, f"{len(table)} rows", "a row of names and rows of data follow",
                         "Copy the file again")
        )  # fmt: skip
        return None
    line, names = table[0][0], [cell.strip() for cell in table[0][1]]
    found = len(problems)
    for name in wanted:
        if name not in names:
            # A unit stands in the name: the same quantity in another one is not the same column.
            stem = name.rsplit(" ", 1)[0]
            like = [other for other in names if " " in name and other.startswith(stem)]
            mend = f"Convert the column {like[0]!r}" if like else "Add the column"
            problems.append(
                InputProblem(f"{path.name}, line {line}", f"columns {', '.join(names[:8])}, …",
                             f"there must be a column {name!r}", mend)
            )  # fmt: skip
    for name in sorted({name for name in names if names.count(name) > 1}):
        problems.append(
            InputProblem(f"{path.name}, line {line}", f"{name!r} {names.count(name)} times",
                         "a column has a name of its own", "Rename or remove the others")
        )  # fmt: skip
    for number, row in table[1:]:
        if len(row) != len(names) and len(problems) - found < MAX_PROBLEMS:
            problems.append(
                InputProblem(f"{path.name}, line {number}", f"{len(row)} cells",
                             f"every row has {len(names)} cells, as the first has",
                             "Complete the row, or remove it")
            )  # fmt: skip
    return Rows(path.name, names, table[1:]) if len(problems) == found else None


def number(file: str, line: int, name: str, cell: str, problems: list[InputProblem]) -> float:
    """A cell that must be a finite number ≥ 0; NaN, and what is wrong, where it is not."""
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if np.isfinite(value) and value >= 0:
        return value
    rule = "it must be ≥ 0" if np.isfinite(value) else "it must be a finite number"
    problems.append(
        InputProblem(f"{file}, line {line}, column {name!r}", repr(cell), rule,
                     "Mend the cell: a gap is not a value")
    )  # fmt: skip
    return np.nan


def read_hourly(path: Path, problems: list[InputProblem]) -> Hourly | None:
    """The hours of a file whose first columns are Year, Month, Day, Period (1 to 24)."""
    table = read_rows(path, _CLOCK, problems)
    if table is None:
        return None
    found: list[InputProblem] = []
    clock = [table.column(name) for name in _CLOCK]
    others = [k for k in range(len(table.names)) if k not in clock]
    values = np.full((len(table.rows), len(others)), np.nan)
    hours: list[datetime.datetime | None] = []
    for k, (line, cells) in enumerate(table.rows):
        hours.append(_hour(table.file, line, [cells[j] for j in clock], found))
        row = [cells[j] for j in others]
        try:
            values[k] = row
        except ValueError:
            pass  # The cells that are no numbers stay NaN, and are found below.
        for j in np.flatnonzero(~(np.isfinite(values[k]) & (values[k] >= 0))):
            number(table.file, line, table.names[others[j]], row[j], found)
        if len(found) >= MAX_PROBLEMS:
            break
    lines = [line for line, _ in table.rows]
    found += _gaps(table.file, lines, hours)
    problems += found[:MAX_PROBLEMS]
    if found or hours[0] is None:
        return None
    return Hourly(table.file, hours[0], [table.names[j] for j in others], values, lines)


def same_hours(tables: list[Hourly], problems: list[InputProblem]) -> None:
    """Tell where files do not cover the same hours."""
    first = tables[0]
    for other in tables[1:]:
        if (other.start, len(other.values)) != (first.start, len(first.values)):
            problems.append(
                InputProblem(
                    other.file,
                    f"{len(other.values)} hours from {other.start:%Y-%m-%d %H:%M}",
                    f"it must cover the hours of {first.file}: {len(first.values)} from "
                    f"{first.start:%Y-%m-%d %H:%M}",
                    "Cut the files to the hours that all of them have",
                )
            )


def no_files(paths: list[Path]) -> InputError | None:
    """What to say of files that are not there."""
    wrong = [
        InputProblem(str(path.parent), f"no {path.name}", "the market is read from four files",
                     "Copy it there from RTS-GMLC's RTS_Data")
        for path in paths if not path.is_file()
    ]  # fmt: skip
    return InputError(*wrong) if wrong else None


def _hour(
    file: str, line: int, cells: list[str], problems: list[InputProblem]
) -> datetime.datetime | None:
    """The beginning of the hour that a row is for."""
    try:
        year, month, day, period = (int(cell) for cell in cells)
        if not 1 <= period <= 24:
            raise ValueError("a day has the periods 1 to 24")
        return datetime.datetime(year, month, day, period - 1)
    except ValueError as error:
        problems.append(
            InputProblem(f"{file}, line {line}", "/".join(cells), f"it must be an hour: {error}",
                         "Write Year, Month, Day and Period as integers")
        )  # fmt: skip
        return None


def _gaps(file: str, lines: list[int], hours: list[datetime.datetime | None]) -> list[InputProblem]:
    step = datetime.timedelta(hours=1)
    return [
        InputProblem(
            f"{file}, line {lines[k + 1]}",
            f"{after:%Y-%m-%d} period {after.hour + 1} after {before:%Y-%m-%d} period "
            f"{before.hour + 1}",
            "rows are an hour apart: over a gap nothing is known, and a repeated hour is ambiguous",
            "Fill in the missing hours on purpose, or remove what is twice",
        )
        for k, (before, after) in enumerate(itertools.pairwise(hours))
        if before is not None and after is not None and after - before != step
    ]
