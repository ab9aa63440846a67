"""Any text is a formula with the value of an independent evaluator, or refused with its column."""

import numpy as np
import pytest
from tests.fuzz import expressions
from tests.fuzz.limits import examine

from dvax.app.runs.expressions import compile_expression

PARTS = [pytest.param(k, marks=pytest.mark.thorough) for k in range(4)]
SIZE = 2_500


def verdicts(first: int, last: int) -> list[str]:
    """Judge texts; where one is a formula, its value is that of the reference."""
    found = []
    for number in range(first, last):
        text = expressions.text(number)
        verdict, value = examine(lambda text=text: evaluated(text))
        assert verdict != "broken", f"expression {number}, {text[:80]!r}: {value}"
        if verdict == "refused":
            for problem in value.problems:
                assert problem.place.startswith("expression"), problem
        else:
            expected = expressions.reference(text)
            assert expected is not None, (number, text)
            known = np.isfinite(expected)
            got = np.broadcast_to(value, expected.shape)
            size = np.maximum(1.0, np.abs(expected[known]))
            assert np.all(np.abs(got[known] - expected[known]) <= 1e-6 * size), (number, text)
        found.append(verdict)
    return found


def evaluated(text: str) -> np.ndarray:
    with np.errstate(all="ignore"):
        return np.asarray(compile_expression(text).numpy(**expressions.POINTS))


def test_random_formulas_agree_with_the_reference_or_are_refused() -> None:
    found = verdicts(0, 1000)
    assert 0.2 < found.count("read") / len(found) < 0.8
    attacks = found[: len(expressions.ATTACKS)]
    assert attacks.count("refused") > 0.8 * len(attacks)


@pytest.mark.parametrize("part", PARTS)
def test_many_random_formulas_agree_with_the_reference_or_are_refused(part: int) -> None:
    verdicts(part * SIZE, (part + 1) * SIZE)
