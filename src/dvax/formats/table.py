"""Columns of numbers with units, read from CSV files.

The first row that is no comment names the columns, each with its unit in brackets::

    # anything after a hash at the start of a line is a comment
    time [s], load [um/s]
    0.00, 0.12
    0.02, 0.31

Every flaw of the file is reported with its line and column, up to `MAX_PROBLEMS` of them at once.
"""

import csv
import math
import re
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from ..errors import InputError, InputProblem

MAX_PROBLEMS = 20
NUMBER = re.compile(r"[+-]?(\d+(?:\.\d*)?|\.\d+)([eE][+-]?\d{1,3})?")
"""A decimal number; what ``float`` also takes (``nan``, ``1_000``) is refused."""
_HEADER = re.compile(r"\s*(?P<name>[^\[\]]+?)\s*(\[\s*(?P<unit>[^\[\]]*?)\s*\]\s*)?")


@dataclass(frozen=True)
class Column:
    """A column: finite `values`, their `unit` as written, and the `lines` of the file they stand
    on."""

    name: str
    unit: str
    values: np.ndarray
    lines: np.ndarray


def read_columns(path: Path, wanted: list[str | None], key_column: str) -> list[Column]:
    """The `wanted` columns of a CSV file, in that order.

    None stands for "the one column besides `key_column`". Raises `InputError` with every problem:
    a missing column or unit, a gap, text, NaN or infinity in a number column, rows of other
    lengths.
    """
    name = path.name
    problems: list[InputProblem] = []
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _error(
            f"{name}, byte {error.start + 1}",
            "bytes that are not UTF-8",
            "a CSV file is UTF-8 text",
            "Save it as UTF-8.",
        ) from None
    rows = _rows(name, text)
    if not rows:
        raise _error(
            name, "no rows", "the first row names the columns", 'Write "time [s],load [um/s]".'
        )
    header_line, header = rows[0]
    names, units = _read_header(name, header_line, header, problems)
    chosen = [_choose(name, header_line, w, key_column, names, problems) for w in wanted]
    for index in {i for i in chosen if i is not None}:
        if units[index] is None:
            problems.append(
                InputProblem(
                    f"{name}, line {header_line}, column {names[index]!r}",
                    repr(header[index].strip()),
                    "a column of numbers says its unit, or nobody knows what the numbers mean",
                    f'Write "{names[index]} [unit]", or [1] for pure numbers.',
                )
            )
    if any(i is None for i in chosen):
        raise InputError(*problems[:MAX_PROBLEMS])
    if len(rows) == 1:
        problems.append(
            InputProblem(
                name, "a header and no data", "a column has values", "Add rows of numbers."
            )
        )
    indices = [i for i in chosen if i is not None]
    table = _read_numbers(name, rows[1:], names, indices, problems)
    if problems:
        raise InputError(*problems[:MAX_PROBLEMS])
    lines = np.array([line for line, _ in rows[1:]])
    return [Column(names[i], units[i] or "1", table[:, k], lines) for k, i in enumerate(indices)]


def read_bytes(path: Path) -> bytes:
    """The content of a file. Raises `InputError` where the system refuses to read it."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise _error(
            path.name,
            error.strerror or str(error),
            "a data file must be readable",
            "Check its permissions.",
        ) from None


def check_increasing(file: str, column: Column) -> None:
    """Raise `InputError` for every value (at most 20) that does not exceed the one before it."""
    back = np.flatnonzero(~(np.diff(column.values) > 0))[:MAX_PROBLEMS]
    if back.size:
        raise InputError(
            *(
                InputProblem(
                    f"{file}, line {column.lines[i + 1]}, column {column.name!r}",
                    f"{column.values[i + 1]:.12g} after {column.values[i]:.12g}",
                    "it must increase strictly: a repeated or reversed value is ambiguous",
                    "Sort the rows and remove repetitions; two close values make a jump.",
                )
                for i in back
            )
        )


def _rows(name: str, text: str) -> list[tuple[int, list[str]]]:
    """(line, cells) of every row that is neither blank nor a comment."""
    reader = csv.reader(text.splitlines(), strict=True, skipinitialspace=True)
    rows: list[tuple[int, list[str]]] = []
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells) and not cells[0].lstrip().startswith("#"):
                rows.append((reader.line_num, cells))
    except csv.Error as error:
        raise _error(
            f"{name}, line {reader.line_num}",
            str(error),
            "every line is cells with commas between",
            "Check the quotes.",
        ) from None
    return rows


def _read_header(
    file: str, line: int, header: list[str], problems: list[InputProblem]
) -> tuple[list[str], list[str | None]]:
    names: list[str] = []
    units: list[str | None] = []
    for number, cell in enumerate(header, start=1):
        match = _HEADER.fullmatch(cell) if len(cell) <= 200 else None
        title = match["name"] if match else cell.strip() or f"column {number}"
        place = f"{file}, line {line}, column {number}"
        if match is None or NUMBER.fullmatch(title):
            semicolons = " This file seems to use semicolons; use commas." if ";" in cell else ""
            problems.append(
                InputProblem(
                    place,
                    repr(cell.strip()[:60]),
                    "the first row names each column",
                    f'Write "name [unit]" there, such as "time [s]".{semicolons}',
                )
            )
        elif title in names:
            problems.append(
                InputProblem(place, repr(title), "a column name stands once", "Rename one of them.")
            )
        names.append(title)
        units.append(match["unit"] or None if match else None)
    return names, units


def _choose(
    file: str,
    line: int,
    wanted: str | None,
    key_column: str,
    names: list[str],
    problems: list[InputProblem],
) -> int | None:
    if wanted is None:
        others = [i for i, name in enumerate(names) if name != key_column]
        if len(others) == 1:
            return others[0]
        problems.append(
            InputProblem(
                f"{file}, line {line}",
                f"columns {', '.join(map(repr, names))}",
                f"without a column's name there is exactly one besides {key_column!r}",
                "Add column = with one of these names.",
            )
        )
        return None
    if wanted in names:
        return names.index(wanted)
    close = get_close_matches(wanted, names, n=1)
    problems.append(
        InputProblem(
            f"{file}, line {line}",
            f"columns {', '.join(map(repr, names))}",
            f"there is no column {wanted!r}",
            f"Did you mean {close[0]!r}?" if close else "Name one of these columns.",
        )
    )
    return None


def _read_numbers(
    file: str,
    rows: list[tuple[int, list[str]]],
    names: list[str],
    indices: list[int],
    problems: list[InputProblem],
) -> np.ndarray:
    table = np.zeros((len(rows), len(indices)))
    for r, (line, cells) in enumerate(rows):
        if len(problems) >= MAX_PROBLEMS:
            break
        if len(cells) != len(names):
            problems.append(
                InputProblem(
                    f"{file}, line {line}",
                    f"{len(cells)} cells",
                    f"every row has {len(names)} cells, as the header has",
                    "Complete the row or remove it.",
                )
            )
            continue
        for k, i in enumerate(indices):
            cell = cells[i].strip()
            value = float(cell) if NUMBER.fullmatch(cell) else math.nan
            if math.isfinite(value):
                table[r, k] = value
                continue
            problems.append(
                InputProblem(
                    f"{file}, line {line}, column {names[i]!r}",
                    "an empty cell" if not cell else repr(cell[:40]),
                    "a gap is not a value"
                    if not cell
                    else "a number column holds finite decimal numbers with a point",
                    "Remove the row or fill in a measured value on purpose.",
                )
            )
    return table


def _error(place: str, given: str, rule: str, mend: str) -> InputError:
    return InputError(InputProblem(place, given, rule, mend))
