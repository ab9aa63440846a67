"""CSV: a table for a spreadsheet, one column for every entry, `name[index] [unit]` above it."""

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dvax.app.runs.export.selection import Selection
from dvax.app.runs.export.tables import Table, tables

SUFFIX = ".csv"
WIDE = 50
"""A variable with more entries than this has a table of its own."""
_SPREADSHEET = 2**14
"""The columns that spreadsheet programs can open."""


def parts(selection: Selection) -> dict[str, Any]:
    """Return, by the name of each table, the function that writes it to a path."""
    return {label: _writer(selection, table) for label, table in _split(selection).items()}


def notes(selection: Selection) -> list[str]:
    """Return a sentence about each table that is too wide for a spreadsheet program."""
    found = []
    for label, table in _split(selection).items():
        width = sum(map(_entries, (selection.variables[n].shape for n in table.names)))
        if width > _SPREADSHEET:
            found.append(
                f"The table {label} has {width} columns. Spreadsheet programs open {_SPREADSHEET}; "
                "NetCDF, Parquet and NPZ have no such limit."
            )
    return found


def _split(selection: Selection) -> dict[str, Table]:
    """Return the tables by name, with wide variables in tables of their own."""
    found: dict[str, Table] = {}
    for table in tables(selection):
        wide = [n for n in table.names if _entries(selection.variables[n].shape) > WIDE]
        narrow = tuple(n for n in table.names if n not in wide)
        if not wide or set(narrow) - {table.dim}:
            found[table.dim or "numbers"] = replace(table, names=narrow)
        index = (table.dim,) if table.dim in narrow else ()
        found |= {name: replace(table, names=(*index, name)) for name in wide}
    return found


def _writer(selection: Selection, table: Table) -> Any:
    def write(path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            index = [table.dim] if table.has_index else []
            writer.writerow([*index, *(h for n in table.names for h in _heads(selection, n))])
            for block, values in table.blocks(selection):
                for k in range(block.stop - block.start):
                    row = [block.start + k] if table.has_index else []
                    writer.writerow(
                        [*row, *(cell for v in values.values() for cell in _cells(v[k]))]
                    )

    return write


def _heads(selection: Selection, name: str) -> list[str]:
    """Return the heads of the columns of a variable."""
    shape, unit = selection.variables[name].shape[1:], selection.unit(name)
    is_bracketed = unit.startswith("[") and unit.endswith("]")
    bracket = "" if unit in ("", "1") else f" {unit}" if is_bracketed else f" [{unit}]"
    if not shape:
        return [name + bracket]
    return [f"{name}[{','.join(map(str, index))}]{bracket}" for index in np.ndindex(*shape)]


def _cells(values: np.ndarray) -> list[Any]:
    """Return the cells of a row: numbers with all their digits, NaN as an empty cell."""
    if values.dtype.kind != "f" or not np.isnan(values).any():
        return values.tolist()
    return ["" if v != v else v for v in values.tolist()]


def _entries(shape: Sequence[int]) -> int:
    return int(np.prod(shape[1:]))
