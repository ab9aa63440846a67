"""One assumption of the paper, and what is known about it."""

from typing import Any, NamedTuple

from .status import Status


class Assumption(NamedTuple):
    """An assumption with its label in the paper.

    - `status`: "proved", "declared", "estimated" or "refuted";
    - `why`: how it is known, or what contradicts it, with the numbers;
    - `needed`: whether the theory rests on it; what is only one of two sufficient conditions is not;
    - `evidence`: the points of a counterexample, where there is one.
    """

    label: str
    statement: str
    status: Status
    why: str
    needed: bool = True
    evidence: Any = None
