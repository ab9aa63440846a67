"""What must be true of the arguments of a traffic model, and of its two files together."""

import math
import os
from typing import Any

import numpy as np

from ...errors import InputProblem, Problems
from ...formats.road_network import Network, Trips
from ...formats.tntp import read_network, read_trips
from .shortest import ShortestPaths


def loaded(network: Any, trips: Any) -> tuple[Network, Trips]:
    """Both, read from files where they are names of such. Raises `InputError` with what is wrong in
    either."""
    problems = Problems()
    found: list[Any] = []
    for given, kind, read in ((network, Network, read_network), (trips, Trips, read_trips)):
        if not isinstance(given, (kind, str, os.PathLike)):
            name = kind.__name__.lower()
            problems.add(
                f"dvax.models.Traffic({name})", repr(given)[:60],
                f"it is a dvax.models.{kind.__name__}, or the name of a TNTP file",
                f"Read it: dvax.formats.{read.__name__}(...)",
            )  # fmt: skip
            continue
        with problems.collect():
            found.append(given if isinstance(given, kind) else read(given))
    problems.raise_any()
    return found[0], found[1]


def numbers(**given: Any) -> list[InputProblem]:
    """What is wrong with the numbers of the model, by name."""
    rules = {"rate": "> 0", "rho": "> 0", "gap": "> 0"}
    problems = Problems()
    for name, value in given.items():
        if name == "rho" and value is None:
            continue
        real = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        rule = rules.get(name, "≥ 0")
        if not (real and math.isfinite(value) and (value > 0 if rule == "> 0" else value >= 0)):
            problems.add(
                f"dvax.models.Traffic({name})", repr(value), f"it is a number {rule}",
                "Fix the number",
            )  # fmt: skip
    return problems


def agreement(network: Network, trips: Trips) -> list[InputProblem]:
    """What is wrong between a network and a trip table: other zones, no trips, pairs without a path."""
    if network.zones != trips.zones:
        return [
            InputProblem(
                f"{network.name} and {trips.name}",
                f"{network.zones} zones and {trips.zones}",
                "both are of one network", "Take the two files of one network",
            )
        ]  # fmt: skip
    if len(trips) == 0:
        return [
            InputProblem(
                trips.name, "no trips between two zones", "without trips nothing is to be solved",
                "Add trips",
            )
        ]  # fmt: skip
    least, _ = ShortestPaths(network, trips).find(np.ones(len(network)))
    cut_off = np.flatnonzero(~np.isfinite(least))
    problems = Problems(
        InputProblem(
            trips.place(i),
            f"{trips.flow[i]:g} trips from {trips.origin[i]} to {trips.destination[i]}",
            f"{network.name} has no path for them"
            + _why(network, trips.origin[i], trips.destination[i]),
            "Add a link, or leave the trips out",
        )
        for i in cut_off[:20]
    )  # fmt: skip
    if len(cut_off) > 20:
        problems.add(
            trips.name, f"{len(cut_off) - 20} more pairs without a path",
            "the first 20 are shown: often one link makes them all", "Fix those first",
        )  # fmt: skip
    return problems


def _why(network: Network, origin: Any, destination: Any) -> str:
    if not np.any(network.init_node == origin):
        return f": no link leaves {origin}"
    if not np.any(network.term_node == destination):
        return f": no link enters {destination}"
    if network.first_thru_node > 1:
        return f" that passes through no node below {network.first_thru_node} (FIRST THRU NODE)"
    return ""
