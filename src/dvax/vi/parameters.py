"""Rules for the numeric parameters of solvers and of `dvax.solve_vi`."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .. import _tree
from ..errors import InputProblem, Problems


class Rule(NamedTuple):
    """The admissible values of a number: a predicate and its description."""

    holds: Callable[[Any], Any]
    words: str
    whole: bool = False


TOLERANCE = Rule(lambda v: v >= 0, "it must be a number ≥ 0")
MODULUS = Rule(lambda v: 0 < v < math.inf, "it must be a positive, finite number")
SAFETY = Rule(lambda v: 0 < v < 1, "it must be a number in (0, 1)")
GOLDEN = Rule(
    lambda v: 1 < v <= (1 + math.sqrt(5)) / 2, "it must be a number in (1, 1.618], to (1 + √5)/2"
)
LEAST = Rule(lambda v: 0 <= v < math.inf, "it must be a finite number ≥ 0")
STEPS = Rule(lambda v: 1 <= v < 2**31, f"it must be a whole number from 1 to {2**31 - 1}", True)
UNKNOWNS = Rule(lambda v: v >= 0, "it must be a whole number ≥ 0", True)


def obeys(rule: Rule, value: Any) -> bool:
    """Return whether `value` is one real number that satisfies `rule`; a traced one is not compared."""
    if not _tree.is_number(value):
        return False
    if rule.whole and not (isinstance(value, int) or np.result_type(value).kind in "iu"):
        return False
    return not _tree.is_concrete(value) or bool(rule.holds(np.asarray(value)))


def check_parameters(solver: Any, **rules: Rule) -> None:
    """Raise an `InputError` with every parameter of a solver that breaks its rule."""
    cls = type(solver)
    problems = Problems(
        InputProblem(
            f"dvax.vi.{cls.__name__}({name})", describe(value), rule.words,
            f"Omit it for {cls.__dataclass_fields__[name].default}",
        )
        for name, rule in rules.items()
        if not obeys(rule, value := getattr(solver, name))
    )  # fmt: skip
    problems.raise_any()


def describe(value: Any) -> str:
    """Return the value with its type, on one line."""
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return _tree.short(value) if _is_plain(value) else f"an array of {value.dtype}"
    return " ".join(f"{type(value).__name__} {value!r}".split())[:200]


def _is_plain(value: Any) -> bool:
    return getattr(value.dtype, "kind", "") in ("b", "f", "i", "u", "c")
