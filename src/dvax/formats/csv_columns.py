"""Columns of numbers with units, read from CSV files.

The first row that is no comment names the columns, each with its unit in brackets::

    # anything after a hash at the start of a line is a comment
    time [s], load [um/s]
    0.00, 0.12
    0.02, 0.31
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError, InputProblem
from .table import MAX_PROBLEMS, NUMBER, FileProblems, Table, csv_rows

_HEADER = re.compile(r"\s*(?P<name>[^\[\]]+?)\s*(\[\s*(?P<unit>[^\[\]]*?)\s*\]\s*)?")


@dataclass(frozen=True)
class Column:
    """Finite `values`, their `unit` as it is written, and the `lines` of the file they stand on."""

    name: str
    unit: str
    values: np.ndarray
    lines: np.ndarray


def read_columns(
    path: Path,
    wanted: list[str | None],
    key_column: str,
    choose: str = "Add column = with one of these names",
) -> list[Column]:
    """Return the `wanted` columns of a CSV file, in that order.

    None stands for "the one column besides `key_column`", and `choose` says what to do where there are
    several. Raises `InputError` with every problem:
    a missing column or unit, a gap, text, NaN or infinity in a number column, rows of other
    lengths.
    """
    problems = FileProblems(path)
    rows = csv_rows(path, problems)
    if not rows:
        fix = 'Write "time [s],load [um/s]"'
        problems(None, "no rows", "the first row names the columns", fix)
        raise problems.error()
    line, header = rows[0]
    names: list[str] = []
    units: dict[str, str | None] = {}
    for number, cell in enumerate(header, start=1):
        match = _HEADER.fullmatch(cell) if len(cell) <= 200 else None
        title = match["name"] if match else cell or f"column {number}"
        if match is None or NUMBER.fullmatch(title):
            semicolons = " This file seems to use semicolons; use commas." if ";" in cell else ""
            fix = f'Write "name [unit]" there, such as "time [s]".{semicolons}'
            problems(line, repr(cell[:60]), "the first row names each column", fix, number)
        names.append(title)
        units[title] = match["unit"] or None if match else None
    table = Table(line, names, rows[1:], problems)
    there = table.has(*(name for name in wanted if name is not None))
    named = [name or _only_other(table, key_column, choose) for name in wanted]
    chosen = [name for name in named if name is not None]
    if not there or len(chosen) < len(wanted):
        raise problems.error()
    for name in chosen:
        if units[name] is None:
            problems(
                line, repr(header[names.index(name)]),
                "a column of numbers names its unit, without which the numbers have no meaning",
                f'Write "{name} [unit]", or [1] for pure numbers', name,
            )  # fmt: skip
    if len(rows) == 1:
        problems(None, "a header and no data", "a column has values", "Add rows of numbers")
    columns = table.columns(chosen)
    problems.check()
    return [Column(name, units[name] or "1", columns[name], columns["lines"]) for name in chosen]


def column_names(path: Path) -> list[str]:
    """Return the names in the first row of a CSV file, without their units."""
    rows = csv_rows(path, FileProblems(path))
    found = [_HEADER.fullmatch(cell) for cell in (rows[0][1] if rows else []) if len(cell) <= 200]
    return [match["name"] for match in found if match is not None]


def _only_other(table: Table, key_column: str, choose: str) -> str | None:
    """Return the one column besides `key_column`; None, and a problem, where there are several."""
    others = [name for name in table.names if name != key_column]
    if len(others) == 1:
        return others[0]
    given = f"columns {', '.join(map(repr, table.names))}"
    rule = f"without a column's name there is exactly one besides {key_column!r}"
    table.problems(table.header, given, rule, choose)
    return None


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
                    "Sort the rows and remove repetitions; two close values make a jump",
                )
                for i in back
            )
        )
