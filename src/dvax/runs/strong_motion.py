"""Accelerograms in the PEER strong-motion format (.at2).

A few lines of description that state the unit g (standard gravity), a line such as
``NPTS=  1559, DT= .02000 SEC``, then the accelerations in rows. The first sample is at time 0.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvax.errors import InputError, InputProblem
from dvax.runs.csv_table import MAX_PROBLEMS
from dvax.runs.data_file import read_bytes
from dvax.runs.units import NUMBER

_SIZES = re.compile(
    r"NPTS\s*=\s*(?P<points>\d{1,9})\s*,\s*DT\s*=\s*(?P<step>\d*\.?\d+(?:[eE][+-]?\d+)?)"
    r"\s*,?\s*(?P<unit>[A-Za-z]*)",
    re.IGNORECASE,
)
_GRAVITY = re.compile(r"units?\b[^\n]*?(\(\s*g\s*\)|\bg\b)", re.IGNORECASE)


@dataclass(frozen=True)
class StrongMotion:
    """`acceleration` in units of standard gravity, at `times` in seconds from 0."""

    times: np.ndarray
    acceleration: np.ndarray


def read_strong_motion(path: Path) -> StrongMotion:
    """Read an .at2 file. Raises `InputError` with the line of every problem."""
    name = path.name
    lines = read_bytes(path).decode("latin-1").splitlines()  # descriptions are of any encoding

    def problem(line: int | None, given: str, rule: str, mend: str) -> InputProblem:
        return InputProblem(name if line is None else f"{name}, line {line}", given, rule, mend)

    found = next(((i, m) for i, t in enumerate(lines) if (m := _SIZES.search(t))), None)
    if found is None:
        raise InputError(
            problem(
                None,
                f"{len(lines)} lines without NPTS= and DT=",
                "an .at2 file states the number of points and the step",
                "Add a line such as NPTS=  1559, DT= .02000 SEC.",
            )
        )
    start, sizes = found
    problems: list[InputProblem] = []
    points, step = int(sizes["points"]), float(sizes["step"])
    if points < 2 or not 0 < step < float("inf"):
        problems.append(
            problem(
                start + 1,
                f"NPTS={points}, DT={step:g}",
                "a record has at least two points and a positive step",
                "Mend the line.",
            )
        )
    if sizes["unit"].lower() not in {"", "s", "sec", "second", "seconds"}:
        problems.append(
            problem(start + 1, repr(sizes["unit"]), "the step is in seconds", "Convert it to SEC.")
        )
    if not any(_GRAVITY.search(line) for line in lines[:start]):
        problems.append(
            problem(
                None,
                "a description without the unit",
                "an .at2 file states that its values are in units of g",
                "Add a line such as: The units are (g).",
            )
        )
    values: list[float] = []
    for number, line in enumerate(lines[start + 1 :], start=start + 2):
        if line.lstrip().startswith("***"):
            break
        for match in re.finditer(r"\S+", line):
            if NUMBER.fullmatch(match[0]):
                values.append(float(match[0]))
            elif len(problems) < MAX_PROBLEMS:
                problems.append(
                    problem(
                        number,
                        f"{match[0][:40]!r} at column {match.start() + 1}",
                        "accelerations are finite decimal numbers with blanks between",
                        "Mend or remove it.",
                    )
                )
    if not problems and len(values) != points:
        problems.append(
            problem(
                start + 1,
                f"NPTS={points} and {len(values)} values",
                "the record holds as many values as it states",
                "Complete the file or mend NPTS.",
            )
        )
    if not problems and not np.all(np.isfinite(values)):
        problems.append(problem(None, "an infinite value", "values are finite", "Mend it."))
    if problems:
        raise InputError(*problems)
    return StrongMotion(step * np.arange(points), np.array(values))
