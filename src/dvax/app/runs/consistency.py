"""Rules between the values of a configuration file, read from the file as it was written."""

from collections.abc import Mapping
from typing import Any

from dvax.app.runs.schema_errors import shown
from dvax.errors import InputProblem

_BOUNDARIES = ({"length", "points"}, {"lengths", "points"}, {"file"})


def check_consistency(raw: Mapping[str, Any], file: str) -> list[InputProblem]:
    """All problems between keys of one section. Sections that are no tables are left to the
    schema."""
    problems: list[InputProblem] = []

    def table(name: str) -> Mapping[str, Any] | None:
        section = raw.get(name)
        return section if isinstance(section, Mapping) else None

    boundary = table("boundary")
    if boundary is not None:
        problems += _boundary(boundary, file)
    for name in ("demand", "load"):
        section = table(name)
        if section is not None:
            problems += _field(section, name, file)
    solver = table("solver")
    others = [key for key in ("rtol", "atol", "dt_max") if key in (solver or ())]
    if solver is not None and "dt" in solver and others:
        problems.append(
            InputProblem(
                f"{file}: solver",
                f"dt together with {' and '.join(others)}",
                "steps are fixed by dt or chosen for tolerances, not both",
                "Keep dt, or keep the others.",
            )
        )
    return problems


def _boundary(section: Mapping[str, Any], file: str) -> list[InputProblem]:
    given = set(section) & {"length", "lengths", "points", "file"}
    place = f"{file}: boundary"
    if given not in _BOUNDARIES:
        return [
            InputProblem(
                place,
                ", ".join(sorted(given)) or "none of length, lengths, points, file",
                "a boundary is length and points, or lengths and points, or a file of nodes",
                "Give exactly one of the three.",
            )
        ]
    points = section.get("points")
    if "lengths" in given and type(points) is int:
        return [
            InputProblem(
                f"{place}.points",
                shown(points),
                "lengths = [a, b] needs a number of points for each direction",
                "Write points = [n1, n2].",
            )
        ]
    if "length" in given and isinstance(points, list):
        return [
            InputProblem(
                f"{place}.points",
                shown(points),
                "length = ... is one-dimensional and has one number of points",
                "Write points = n, or lengths = [a, b].",
            )
        ]
    return []


def _field(section: Mapping[str, Any], name: str, file: str) -> list[InputProblem]:
    problems = []
    if not {"value", "expression", "series", "profile"} & set(section):
        problems.append(
            InputProblem(
                f"{file}: {name}",
                "no factor",
                "it is the product of value, expression, series and profile, at least one of them",
                "Write value = 0.0 for none.",
            )
        )
    if "knots" in section and "expression" not in section:
        problems.append(
            InputProblem(
                f"{file}: {name}.knots",
                shown(section["knots"]),
                "knots are the times where the expression has a kink; measured data has its own",
                "Remove knots or give the expression.",
            )
        )
    return problems
