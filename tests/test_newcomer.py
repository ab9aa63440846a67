"""Whatever a newcomer gets wrong is answered by an `InputError` that names the place and the fix."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from tests import newcomer

NAMES = [
    (f"{group}: {name}", words)
    for group, cases in newcomer.CASES.items()
    for name, (_, words) in cases.items()
]


@pytest.fixture(scope="module")
def answers():
    done = subprocess.run(
        [sys.executable, newcomer.__file__], capture_output=True, text=True, timeout=600,
        env=os.environ | {"PYTHONPATH": str(Path(newcomer.dvax.__file__).parents[1])},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(("name", "words"), NAMES, ids=[name for name, _ in NAMES])
def test_bad_input_is_an_input_error_that_names_place_and_fix(answers, name, words):
    kind, message = answers[name]
    assert kind == "InputError", message
    for word in words.split("; "):
        assert word in re.sub(r"line \d+", "line", message), message
    for line in message.splitlines():
        assert len(line) < 1000, "one problem a line, and a line of values at most"
        place, _, rest = line.partition(": got ")
        assert place and "; " in rest, "place: got what; the rule. The fix"
