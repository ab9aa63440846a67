"""Accelerograms in the PEER strong-motion format (.at2).

A few lines of description that state the unit g (standard gravity), a line such as
``NPTS=  1559, DT= .02000 SEC``, then the accelerations in rows. The first sample is at time 0.
"""

import os
import re

import numpy as np

from .table import FileProblems, read_text, to_number

_SIZES = re.compile(
    r"NPTS\s*=\s*(?P<points>\d{1,9})\s*,\s*DT\s*=\s*(?P<step>\d*\.?\d+(?:[eE][+-]?\d+)?)"
    r"\s*,?\s*(?P<unit>[A-Za-z]*)",
    re.IGNORECASE,
)
_UNIT, _GRAVITY = (re.compile(text, re.IGNORECASE) for text in (r"units?\b", r"\bg\b"))


def read_at2(path: str | os.PathLike[str]) -> tuple[float, np.ndarray]:
    """Return the step (s) and the accelerations (in units of standard gravity) of an .at2 file. Raises
    `InputError` with the line of every problem.

    ```python
    >>> import pathlib, tempfile
    >>> from dvax.formats import read_at2
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "record.at2"
    >>> _ = file.write_text('''PEER STRONG MOTION DATABASE RECORD
    ... A synthetic record
    ... ACCELERATION TIME HISTORY IN UNITS OF G
    ... NPTS=  4, DT= .02000 SEC
    ...   0.0   0.1  -0.2   0.05
    ... ''')
    >>> step, acceleration = read_at2(file)
    >>> step, acceleration.tolist()
    (0.02, [0.0, 0.1, -0.2, 0.05])

    ```
    """
    lines, problems = read_text(path, "an .at2 file").splitlines(), FileProblems(path)
    found = next(((i, m) for i, t in enumerate(lines, 1) if (m := _SIZES.search(t))), None)
    if found is None:
        problems(
            None, f"{len(lines)} lines without NPTS= and DT=",
            "an .at2 file states the number of points and the step",
            "Add a line such as NPTS=  1559, DT= .02000 SEC.",
        )  # fmt: skip
        raise problems.error()
    start, sizes = found
    points, step = int(sizes["points"]), float(sizes["step"])
    if points < 2 or not 0 < step < float("inf"):
        rule = "a record has at least two points and a positive step"
        problems(start, f"NPTS={points}, DT={step:g}", rule, "Fix the line")
    if sizes["unit"].lower() not in {"", "s", "sec", "second", "seconds"}:
        problems(start, repr(sizes["unit"]), "the step is in seconds", "Convert it to SEC")
    if not any(_states_gravity(line) for line in lines[: start - 1]):
        problems(
            None, "a description without the unit",
            "an .at2 file states that its values are in units of g",
            "Add a line such as: The units are (g)",
        )  # fmt: skip
    values: list[float] = []
    rule = "accelerations are finite decimal numbers with blanks between"
    for number, line in enumerate(lines[start:], start=start + 1):
        if line.lstrip().startswith("***"):
            break
        for match in re.finditer(r"\S+", line):
            value = to_number(match[0])
            if value is None:
                given = f"{match[0][:40]!r} at column {match.start() + 1}"
                problems(number, given, rule, "Fix or remove it")
            else:
                values.append(value)
    if not problems and len(values) != points:
        problems(
            start, f"NPTS={points} and {len(values)} values",
            "the record holds as many values as it states", "Complete the file or fix NPTS",
        )  # fmt: skip
    problems.check()
    return step, np.array(values)


def _states_gravity(line: str) -> bool:
    """Return whether a line says "unit" and, behind it, "g": "The units are (g)". Two searches, since
    one pattern for both takes quadratic time."""
    unit = _UNIT.search(line)
    return unit is not None and _GRAVITY.search(line, unit.end()) is not None
