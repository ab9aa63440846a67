"""The configurations of the members of a sweep, checked before anything runs."""

from collections.abc import Iterable

import numpy as np

from dvax.app.runs.sweeps.sweep import Sweep
from dvax.errors import InputError, InputProblem, Problems

MOST_CHECKED = 100
"""The most members that are checked before a sweep without a valid one is refused."""


def member_problems(sweep: Sweep, members: Iterable[int]) -> Problems:
    """Return the problems of all of these members, with their numbers and values."""
    problems = Problems()
    for member in members:
        with problems.collect(), sweep.naming(member):
            sweep.config(member)
    return problems


def require_valid_member(sweep: Sweep) -> None:
    """Check members, the first and the last one before those between, until one is valid.

    An invalid member among valid ones fails when the sweep runs, and the others go on.

    **Raises:** `dvax.InputError` if none of them is valid.
    """
    count = min(sweep.count, MOST_CHECKED)
    first, *rest = np.linspace(0, sweep.count - 1, count).astype(int).tolist()
    found: dict[int, tuple[InputProblem, ...]] = {}
    for member in [first, *reversed(rest)]:
        try:
            sweep.config(member)
            return
        except InputError as error:
            found[member] = error.problems
    if len(found) > 1 and len(set(found.values())) == 1:
        # It is the configuration that is wrong, and not what varies in it.
        raise InputError(*found[first])
    problems = member_problems(sweep, [first])
    if len(found) > 1:
        problems.add(
            sweep.source.name, f"no valid one among {len(found)} members that were checked",
            "a sweep has at least one valid member",
            f"dvax sweep {sweep.source.name} --check shows the problems of all {sweep.count} members",
        )  # fmt: skip
    problems.raise_any()
