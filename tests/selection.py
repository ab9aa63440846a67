"""Selection of the cases that run in `make test`; the others run in `make thorough`."""

from collections.abc import Collection, Iterable, Set
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
