"""Words for how much is known about a number, from the strongest to the weakest."""

from typing import Literal

Status = Literal["proved", "declared", "estimated", "refuted"]

ORDER: tuple[Status, ...] = ("proved", "declared", "estimated", "refuted")
"""proved: from structure or a closed form. declared: the user's word. estimated: sampled, a bound
from the wrong side. refuted: a counterexample is known."""


def weakest(*statuses: Status) -> Status:
    """What can be said of a number made from others: no more than of the weakest of them."""
    return ORDER[max(map(ORDER.index, statuses), default=0)]
