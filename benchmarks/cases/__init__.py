"""The cases, one per file: each is a function `run(full) -> Section`, imported on demand."""

import importlib
from typing import Protocol, cast

from ..section import Section

CASES = (
    "field",
    "point",
    "saving",
    "siconos",
    "tools",
    "work_precision",
    "defaults",
    "compile",
    "transforms",
    "certificate",
    "bounds",
    "derivatives",
    "identification",
    "memory",
    "processes",
    "signals",
    "simplices",
    "traffic",
    "traffic_days",
    "published_traffic",
    "box_vi",
    "pointwise",
    "obstacle",
    "rough_contact",
    "american_options",
    "applications",
    "published_circuits",
    "published_earthquake",
    "published_electricity",
    "stiffness",
    "picard",
    "accelerator",
    "ensemble",
    "sweeps",
    "sharding",
    "explore",
)
"""The names that --only takes, in the order of a run."""


class Case(Protocol):
    def __call__(self, full: bool) -> Section:
        """Measure; `full` repeats more and goes further."""
        ...


def load(name: str) -> Case:
    """The case of that name."""
    return cast(Case, importlib.import_module(f".{name}", __name__).run)
