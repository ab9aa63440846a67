"""Abstract interpretation of programs traced by JAX: proofs about the code of f, h, K and F.

Each domain answers one question by a table of rules for operations (`interpreter.Domain`). `DOMAINS`
lists the tables.
"""

from collections.abc import Mapping

from . import analytic, branches, enclosure, matrix, rounding, slope, structure, switching_times
from .interpreter import Rule

DOMAINS: dict[str, Mapping[str, Rule]] = {
    "structure": structure.RULES,
    "matrix": matrix.RULES,
    "enclosure": enclosure.RULES,
    "slope": slope.RULES,
    "rounding": rounding.RULES,
    "branches": branches.RULES,
    "switching times": switching_times.RULES,
    "analytic": analytic.RULES,
}
"""The rules of every domain, by the name of the operation."""
