"""Checks of the arguments of a traffic model, and of the consistency of its two files."""

import math
import os
from typing import Any

import numpy as np

from ...errors import InputProblem, Problems
from ...formats.road_network import Network, Trips
from ...formats.tntp import read_network, read_trips
from .shortest import ShortestPaths


def load(network: Any, trips: Any) -> tuple[Network, Trips]:
    """Return both, read from files if they are file names; raise an `InputError` with all problems."""
    problems = Problems()
    loaded: list[Any] = []
    for given, kind, read in ((network, Network, read_network), (trips, Trips, read_trips)):
        if not isinstance(given, (kind, str, os.PathLike)):
            name = kind.__name__.lower()
            problems.add(
                f"dvax.models.Traffic({name})", repr(given)[:60],
                f"it must be a dvax.models.{kind.__name__}, or the name of a TNTP file",
                f"Read it: dvax.formats.{read.__name__}(...)",
            )  # fmt: skip
            continue
        with problems.collect():
            loaded.append(given if isinstance(given, kind) else read(given))
    problems.raise_any()
    return loaded[0], loaded[1]


def number_problems(**given: Any) -> Problems:
    """Return the problems of the numerical arguments."""
    rules = {"rate": "> 0", "rho": "> 0", "gap": "> 0"}
    problems = Problems()
    for name, value in given.items():
        if name == "rho" and value is None:
            continue
        real = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        rule = rules.get(name, "≥ 0")
        if not (real and math.isfinite(value) and (value > 0 if rule == "> 0" else value >= 0)):
            problems.add(
                f"dvax.models.Traffic({name})", repr(value), f"it must be a number {rule}",
                "Correct the number",
            )  # fmt: skip
    return problems


def consistency_problems(network: Network, trips: Trips) -> list[InputProblem]:
    """Return the inconsistencies of a network and a trip table.

    These are different numbers of zones, a table without trips, and pairs without a path."""
    if network.zones != trips.zones:
        return [
            InputProblem(
                f"{network.name} and {trips.name}",
                f"{network.zones} zones and {trips.zones}",
                "both must belong to the same network", "Pass the two files of one network",
            )
        ]  # fmt: skip
    if len(trips) == 0:
        return [
            InputProblem(
                trips.name, "no trips between different zones", "there must be at least one trip",
                "Add trips",
            )
        ]  # fmt: skip
    least, _ = ShortestPaths(network, trips).find(np.ones(len(network)))
    unreachable = np.flatnonzero(~np.isfinite(least))
    problems = Problems(
        InputProblem(
            trips.place(i),
            f"{trips.flow[i]:g} trips from {trips.origin[i]} to {trips.destination[i]}",
            f"{network.name} has no path for them"
            + _reason(network, trips.origin[i], trips.destination[i]),
            "Add a link, or remove the trips",
        )
        for i in unreachable[:20]
    )  # fmt: skip
    if len(unreachable) > 20:
        problems.add(
            trips.name, f"{len(unreachable) - 20} more pairs without a path",
            "only the first 20 are listed: often one link is the cause of all", "Fix those first",
        )  # fmt: skip
    return problems


def _reason(network: Network, origin: Any, destination: Any) -> str:
    if not np.any(network.init_node == origin):
        return f": no link leaves {origin}"
    if not np.any(network.term_node == destination):
        return f": no link enters {destination}"
    if network.first_thru_node > 1:
        return f" that passes through no node below {network.first_thru_node} (FIRST THRU NODE)"
    return ""
