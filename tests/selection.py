"""Selection of cases: those of `make test`, and those of `make thorough`, which ends within hours."""

import os
import re
from collections.abc import Collection, Iterable, Sequence, Set
from typing import Any

import pytest


def mostly_thorough(cases: Iterable[Any], always: Collection[Any]) -> list[Any]:
    """All cases for `pytest.mark.parametrize`, those not in `always` marked thorough."""
    # The order of a set differs between the processes that run tests.
    assert not isinstance(cases, Set), "give the cases as a list"
    cases = list(cases)
    unknown = [case for case in always if case not in cases]
    assert not unknown, f"no such cases: {unknown}"
    return [
        case
        if case in always
        else pytest.param(
            *(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.thorough
        )
        for case in cases
    ]


def spread(cases: Sequence[Any], number: int) -> list[Any]:
    """`number` of the cases at equal distances, from the first one on; all of them with the environment
    variable DVAX_ALL_CASES=1."""
    assert 0 < number < len(cases), "take all cases"
    if os.environ.get("DVAX_ALL_CASES") == "1":
        return list(cases)
    return [cases[k * len(cases) // number] for k in range(number)]


def part_of(items: Sequence[Any], part: str) -> list[Any]:
    """Part "k/n" of the items: every n-th from number k on, so that each has cases of all families.

    **Raises:** `pytest.UsageError` unless 1 <= k <= n."""
    found = re.fullmatch(r"(\d+)/(\d+)", part)
    k, n = (int(found[1]), int(found[2])) if found else (0, 0)
    if not 1 <= k <= n:
        raise pytest.UsageError(f"--part {part}: write k/n with 1 <= k <= n, such as 2/8")
    return list(items[k - 1 :: n])
