"""Accelerograms in the PEER strong-motion format (.at2).

A few lines of description that state the unit g (standard gravity), a line such as
``NPTS=  1559, DT= .02000 SEC``, then the accelerations in rows. The first sample is at time 0.
"""

import os
import re
from pathlib import Path

import numpy as np

from ..errors import InputError, InputProblem

MAX_PROBLEMS = 20
_NUMBER = re.compile(r"[+-]?(\d+(?:\.\d*)?|\.\d+)([eE][+-]?\d{1,3})?")
_SIZES = re.compile(
    r"NPTS\s*=\s*(?P<points>\d{1,9})\s*,\s*DT\s*=\s*(?P<step>\d*\.?\d+(?:[eE][+-]?\d+)?)"
    r"\s*,?\s*(?P<unit>[A-Za-z]*)",
    re.IGNORECASE,
)
_GRAVITY = re.compile(r"units?\b[^\n]*?(\(\s*g\s*\)|\bg\b)", re.IGNORECASE)


def read_at2(path: str | os.PathLike[str]) -> tuple[float, np.ndarray]:
    """The step (s) and the accelerations (in units of standard gravity) of an .at2 file. Raises
    `InputError` with the line of every problem."""
    name = Path(path).name
    try:
        # Descriptions are of any encoding; what is read as data is ASCII or refused.
        lines = Path(path).read_bytes().decode("latin-1").splitlines()
    except OSError as error:
        raise InputError(
            InputProblem(
                str(path), error.strerror or str(error), "an .at2 file must be there and readable",
                "Check the name and the permissions",
            )
        ) from None  # fmt: skip

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
            if _NUMBER.fullmatch(match[0]):
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
    return step, np.array(values)
