"""Programs that JAX has traced, read operation by operation for what they prove.

Each domain answers one question about the code of f, h, K or F, by one table of rules
(`interpreter.Domain`); `DOMAINS` lists them.
"""

from collections.abc import Mapping

from . import branches, enclosure, matrix, rounding, slope, structure, switching_times
from .interpreter import Rule

DOMAINS: dict[str, Mapping[str, Rule]] = {
    "structure": structure.RULES,
    "matrix": matrix.RULES,
    "enclosure": enclosure.RULES,
    "slope": slope.RULES,
    "rounding": rounding.RULES,
    "branches": branches.RULES,
    "switching times": switching_times.RULES,
}
"""The rules of every domain, by the name of the operation."""
