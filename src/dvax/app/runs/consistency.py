"""Rules between the values of a configuration file, read from the file as it was written."""

from collections.abc import Mapping
from typing import Any

from dvax.app.runs.schema_errors import shown
from dvax.errors import Problems

_BOUNDARIES = ({"length", "points"}, {"lengths", "points"}, {"file"})


def check_consistency(raw: Mapping[str, Any], file: str) -> Problems:
    """All problems between keys of one section. Sections that are no tables are left to the
    schema."""
    problems = Problems()
    for name, check in (("boundary", _boundary), ("demand", _field), ("load", _field)):
        if isinstance(raw.get(name), Mapping):
            check(raw[name], f"{file}: {name}", problems)
    return problems


def _boundary(section: Mapping[str, Any], place: str, problems: Problems) -> None:
    given, points = set(section) & {"length", "lengths", "points", "file"}, section.get("points")
    directions = len(points) if isinstance(points, list) else 1
    if given not in _BOUNDARIES:
        problems.add(
            place,
            ", ".join(sorted(given)) or "none of length, lengths, points, file",
            "a boundary is length and points, or lengths and points, or a file of nodes",
            "Give exactly one of the three.",
        )
    elif "lengths" in given and directions < 2:
        rule = "lengths = [a, b] needs a number of points for each direction"
        problems.add(f"{place}.points", shown(points), rule, "Write points = [n1, n2].")
    elif "length" in given and directions > 1:
        rule = "length = ... is one-dimensional and has one number of points"
        fix = "Write points = n, or lengths = [a, b]."
        problems.add(f"{place}.points", shown(points), rule, fix)


def _field(section: Mapping[str, Any], place: str, problems: Problems) -> None:
    if not {"value", "expression", "series", "profile"} & set(section):
        problems.add(
            place,
            "no factor",
            "it is the product of value, expression, series and profile, at least one of them",
            "Write value = 0.0 for none.",
        )
    if "knots" in section and "expression" not in section:
        problems.add(
            f"{place}.knots",
            shown(section["knots"]),
            "knots are the times where the expression has a kink; measured data has its own",
            "Remove knots or give the expression.",
        )
