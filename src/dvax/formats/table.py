"""Tables in text files: a row of names, then rows of cells. Every problem is reported with its line.

`read_text` and `csv_rows` read the rows of a file, `Table` finds columns by name and turns cells into
numbers, and `FileProblems` collects what is wrong with one file, so that all of it is reported at once.
"""

import csv
import io
import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from ..errors import InputError, Problems, input_error

MAX_CELLS = 10_000
"""The most cells of a row of a CSV file."""
MAX_PROBLEMS = 20
"""Problems of one file that are shown: a shifted column alone makes thousands."""
NUMBER = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?")
"""A decimal number; what ``float`` also takes (``nan``, ``1_000``) is refused."""
_COUNT = re.compile(r"\d{1,9}")


class FileProblems(Problems):
    """What is wrong with one file. A call adds a problem; `line` is None where it has none."""

    def __init__(self, path: str | os.PathLike[str]):
        super().__init__()
        self.file = Path(path).name

    def __call__(
        self, line: int | None, given: str, rule: str, fix: str, column: str | int | None = None
    ) -> None:
        place = self.file if line is None else f"{self.file}, line {line}"
        place += "" if column is None else f", column {column!r}"
        self.add(place, given, rule, fix)

    def error(self) -> InputError:
        """Return an `InputError` with the first `MAX_PROBLEMS` problems and a count of the rest."""
        shown, more = Problems(self[:MAX_PROBLEMS]), len(self) - MAX_PROBLEMS
        if more > 0:
            rule = f"the first {MAX_PROBLEMS} are shown: often they have one cause"
            shown.add(self.file, f"{more} more problems", rule, "Fix those first")
        return InputError(*shown)

    def check(self) -> None:
        """Raise `error()` where there are problems."""
        if self:
            raise self.error()


def read_bytes(path: str | os.PathLike[str], kind: str = "a data file") -> bytes:
    """Return the content of a file; `kind` names it in errors. Raises `InputError`."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        given = error.strerror or str(error)
        raise input_error(
            str(path), given, f"{kind} must be readable", "Check the name and the permissions"
        ) from None


def read_text(path: str | os.PathLike[str], kind: str, encoding: str = "latin-1") -> str:
    """Return the text of a file. Latin-1 decodes any bytes: comments may have any encoding, and
    data that is not ASCII is refused by its reader. Raises `InputError`."""
    try:
        return read_bytes(path, kind).decode(encoding)
    except UnicodeDecodeError as error:
        raise input_error(
            f"{Path(path).name}, byte {error.start + 1}",
            "bytes that are not UTF-8", f"{kind} is UTF-8 text", "Save it as UTF-8",
        ) from None  # fmt: skip


def csv_rows(path: Path, problems: FileProblems) -> list[tuple[int, list[str]]]:
    """Return (line, cells) of every row of a CSV file that is neither blank nor a comment (#)."""
    text = read_text(path, "a CSV file", "utf-8-sig")
    # With the ends of its lines, so that a number in quotes over two lines stays two numbers.
    reader = csv.reader(io.StringIO(text, newline=""), strict=True, skipinitialspace=True)
    rows: list[tuple[int, list[str]]] = []
    try:
        for cells in reader:
            if len(cells) > MAX_CELLS:
                rule = f"a row has at most {MAX_CELLS} cells"
                problems(
                    reader.line_num, f"{len(cells)} cells", rule, "Write values below each other"
                )
                raise problems.error()
            cells = [cell.strip() for cell in cells]
            if any(cells) and not cells[0].startswith("#"):
                rows.append((reader.line_num, cells))
    except csv.Error as error:
        problems(
            reader.line_num, str(error), "every line is cells with commas between", "Check the quotes"
        )  # fmt: skip
        raise problems.error() from None
    return rows


class Table:
    """Columns by name. Rows of another length than the header are reported and left out."""

    def __init__(
        self,
        header: int,
        names: list[str],
        rows: list[tuple[int, list[str]]],
        problems: FileProblems,
    ):
        self.header, self.names, self.problems = header, names, problems
        for name, count in sorted(Counter(names).items()):
            if count == 1:
                continue
            given = f"{name!r} {count} times"
            problems(header, given, "a column has a name of its own", "Rename or remove the others")
        rule = f"line {header} names {len(names)} columns, and a gap is not a value"
        for line, cells in rows:
            if len(cells) != len(names):
                problems(line, f"{len(cells)} cells", rule, "Complete the row, or remove it")
        self.rows = [row for row in rows if len(row[1]) == len(names)]

    def has(self, *wanted: str) -> bool:
        """Return whether all these columns are there; each missing one is reported."""
        missing = [name for name in wanted if name not in self.names]
        for name in missing:
            close = get_close_matches(name, [n for n in self.names if n not in wanted], n=1)
            fix = f"Add the column {name}"
            if close:
                # A unit may stand in the name: the same quantity in another unit is another column.
                fix = (
                    f"Did you mean {close[0]!r}? Rename it; convert its values if its unit differs"
                )
            given = f"columns {', '.join(map(repr, self.names[:12]))}"
            self.problems(self.header, given, f"there is no column {name!r}", fix)
        return not missing

    def number(self, line: int, name: str, cell: str, least: float = -math.inf) -> float:
        """Return a cell as a finite number of at least `least`; NaN, and a problem, where it is not
        one."""
        value = to_number(cell)
        if value is not None and value >= least:
            return value
        rule = "it is a finite decimal number with a point; a gap is not a value"
        if value is not None:
            rule = f"it is a number ≥ {least:g}"
        given = repr(cell[:40]) if cell else "an empty cell"
        self.problems(line, given, rule, "Fix the cell, or remove the row", name)
        return math.nan

    def count(self, line: int, name: str, cell: str) -> float:
        """Return a cell as a whole number ≥ 0; NaN, and a problem, where it is not one."""
        value = to_count(cell)
        if value is None:
            rule = "it is a whole number, such as that of a node"
            self.problems(line, repr(cell[:40]), rule, "Fix the cell", name)
        return math.nan if value is None else float(value)

    def columns(
        self, real: Sequence[str], whole: Sequence[str] = (), least: float = -math.inf
    ) -> dict[str, np.ndarray]:
        """Columns of real and of whole numbers by name, and the `lines` of their rows. Rows with a cell
        that is no number are reported and left out."""
        values: dict[str, np.ndarray] = {}
        for name in (*whole, *real):
            index = self.names.index(name)
            values[name] = np.array(
                [
                    self.count(line, name, cells[index])
                    if name in whole
                    else self.number(line, name, cells[index], least)
                    for line, cells in self.rows
                ]
            )
        values["lines"] = np.array([line for line, _ in self.rows], float)
        good = np.logical_and.reduce([np.isfinite(column) for column in values.values()])
        kinds = dict.fromkeys((*whole, "lines"), np.int64)
        return {name: v[good].astype(kinds.get(name, np.float64)) for name, v in values.items()}


def to_number(cell: str) -> float | None:
    """A finite decimal number, or None."""
    value = float(cell) if NUMBER.fullmatch(cell) else math.nan
    return value if math.isfinite(value) else None


def to_count(cell: str) -> int | None:
    """A whole number ≥ 0 of up to nine digits, or None."""
    return int(cell) if _COUNT.fullmatch(cell) else None
