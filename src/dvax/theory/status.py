"""The status of a number or assumption, from the strongest to the weakest."""

from typing import Literal

Status = Literal["proved", "declared", "estimated", "refuted"]

ORDER: tuple[Status, ...] = ("proved", "declared", "estimated", "refuted")
"""proved: from the structure of the problem or a closed form. declared: given by the user. estimated:
from samples, a bound from the wrong side. refuted: a counterexample was found."""


def weakest(*statuses: Status) -> Status:
    """Return the status of a number computed from others: the weakest of theirs.

    ```python
    >>> from dvax.theory import weakest
    >>> weakest("proved", "estimated", "declared")
    'estimated'

    ```
    """
    return ORDER[max(map(ORDER.index, statuses), default=0)]
