"""Selections of cases and parts of a test run."""

import pytest
from tests.selection import part_of, spread


@pytest.mark.parametrize("n", [1, 2, 3, 8, 30])
def test_the_parts_of_a_run_have_every_test_once(n):
    tests = [f"test {k}" for k in range(20)]
    parts = [part_of(tests, f"{k}/{n}") for k in range(1, n + 1)]
    assert sorted(test for part in parts for test in part) == sorted(tests)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("part", ["0/8", "9/8", "1", "1/0", "-1/2", "a/b", ""])
def test_a_wrong_part_is_refused(part):
    with pytest.raises(pytest.UsageError, match="write k/n"):
        part_of([1, 2], part)


def test_a_sample_is_spread_over_the_cases(monkeypatch):
    monkeypatch.delenv("DVAX_ALL_CASES", raising=False)
    assert spread(range(10), 5) == [0, 2, 4, 6, 8]
    monkeypatch.setenv("DVAX_ALL_CASES", "1")
    assert spread(range(10), 5) == list(range(10))
