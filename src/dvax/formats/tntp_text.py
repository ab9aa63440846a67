"""What all files of the TNTP format are made of: metadata in angle brackets, then rows.

<NUMBER OF ZONES> 24
<END OF METADATA>
~  init_node  term_node  capacity ... ;        a line that begins with ~ names the columns
   1          2          25900.2  ... ;        everything behind it is a row
"""

import math
import os
import re
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

from ..errors import InputError, InputProblem

MOST = 20
"""Problems of one file that are shown; the rest is counted."""

_METADATA = re.compile(r"\s*<([^<>]*)>(.*)")
_END = "END OF METADATA"
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_COUNT = re.compile(r"\d{1,9}")


class Line(NamedTuple):
    """A line of a file that is neither blank nor a comment, with its number from 1."""

    number: int
    text: str


class Problems:
    """What is wrong with one file, each with its line."""

    def __init__(self, path: str | os.PathLike[str]):
        self.file = Path(path).name
        self.found: list[InputProblem] = []

    def __call__(self, line: int | None, given: str, rule: str, mend: str) -> None:
        place = self.file if line is None else f"{self.file}, line {line}"
        self.found.append(InputProblem(place, given, rule, mend))

    def error(self) -> InputError:
        """All of them as the exception to raise."""
        shown, more = self.found[:MOST], len(self.found) - MOST
        if more > 0:
            rule = f"the first {MOST} are shown: often one cause makes them all"
            shown.append(InputProblem(self.file, f"{more} more problems", rule, "Mend those first"))
        return InputError(*shown)


def read_lines(path: str | os.PathLike[str]) -> list[str]:
    """The lines of a file. Raises `InputError` where the system refuses to read it."""
    try:
        # Comments are of any encoding; what is read as data is ASCII or refused.
        return Path(path).read_bytes().decode("latin-1").splitlines()
    except OSError as error:
        raise InputError(
            InputProblem(
                str(path),
                error.strerror or str(error),
                "a TNTP file must be there and readable",
                "Check the name and the permissions",
            )
        ) from None


class Metadata:
    """The lines `<KEY> value` of a file, and where each stands."""

    def __init__(self, lines: list[str], problems: Problems):
        self.problems = problems
        self.values: dict[str, Line] = {}
        self.end = 0
        for number, text in enumerate(lines, start=1):
            match = _METADATA.match(text)
            if match is None:
                if text.strip() and not text.lstrip().startswith("~"):
                    break
                continue
            key = " ".join(match[1].upper().split())
            if key == _END:
                self.end = number
                return
            if key in self.values:
                problems(
                    number, f"<{key}> once more",
                    f"it stands once: line {self.values[key].number} has it already",
                    "Remove one of the two",
                )  # fmt: skip
            self.values[key] = Line(number, match[2].strip())
        problems(
            None, f"no line <{_END}>", "it parts the metadata from the rows",
            f"Write <{_END}> on a line of its own behind the metadata",
        )  # fmt: skip

    def count(self, key: str) -> int | None:
        """A whole number ≥ 0, or None where it is missing or wrong, which is noted."""
        found = self._find(key)
        if found is None:
            return None
        if _COUNT.fullmatch(found.text) is None:
            self.problems(
                found.number, f"<{key}> {found.text!r}", "it is a whole number", "Mend the number"
            )
            return None
        return int(found.text)

    def number(self, key: str) -> float | None:
        """A finite number, or None where it is missing or wrong, which is noted."""
        found = self._find(key)
        if found is None:
            return None
        value = to_number(found.text)
        if value is None:
            self.problems(
                found.number, f"<{key}> {found.text!r}", "it is a decimal number", "Mend the number"
            )
        return value

    def line(self, key: str) -> int | None:
        return self.values[key].number if key in self.values else None

    def _find(self, key: str) -> Line | None:
        if key not in self.values:
            close = get_close_matches(key, self.values, n=1)
            mend = f"Write <{key}> in the place of <{close[0]}>" if close else f"Add <{key}>"
            self.problems(None, f"no line <{key}>", "the metadata states it", mend)
            return None
        return self.values[key]


def rows_after(lines: list[str], start: int) -> list[Line]:
    """The lines from `start` on that are neither blank nor comments."""
    kept = []
    for number, text in enumerate(lines[start:], start=start + 1):
        text = text.strip()
        if text and not text.startswith("~"):
            kept.append(Line(number, text))
    return kept


def read_header(text: str) -> list[str]:
    """The columns that a header line names, in lower case and with _ for blanks, without units."""
    text = re.sub(r"\([^()]*\)", "", text.strip().lstrip("~").replace(";", " "))
    cells = text.split("\t") if "\t" in text.strip() else text.split()
    names = ["_".join(cell.split()).lower() for cell in cells]
    return [name for name in names if name]


def to_cells(text: str) -> list[str]:
    """The cells of a row, which a semicolon may end."""
    return text.rstrip(";").split()


def to_number(cell: str) -> float | None:
    """A finite decimal number, or None."""
    if _NUMBER.fullmatch(cell) is None:
        return None
    value = float(cell)
    return value if math.isfinite(value) else None


def to_node(cell: str) -> int | None:
    """A node's number, or None."""
    return int(cell) if _COUNT.fullmatch(cell) else None
