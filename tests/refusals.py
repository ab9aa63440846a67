"""Cases of wrong input, tried in a separate process, with the messages.

A module of cases has `CASES`: by group and name an attempt and words of the message, "; " between them.
"""

import json
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path
from types import ModuleType

import dvax


def said(attempt) -> tuple[str, str]:
    """The type of an exception and its message."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return "answer", repr(attempt())[:200]
        except dvax.DvaxError as error:
            return type(error).__name__, str(error)
        except Exception as error:  # noqa: BLE001 (which kind it is, is the answer)
            return f"raw {type(error).__name__}", str(error)


def print_all(cases) -> None:
    """Try all cases, and print the messages as JSON."""
    tried = {
        f"{group}: {name}": said(attempt)
        for group, those in cases.items()
        for name, (attempt, _) in those.items()
    }
    json.dump(tried, sys.stdout)


def names_and_words(module: ModuleType) -> list[tuple[str, str]]:
    return [
        (f"{group}: {name}", words)
        for group, those in module.CASES.items()
        for name, (_, words) in those.items()
    ]


def answers_of(module: ModuleType) -> dict[str, tuple[str, str]]:
    """The output of `module`, run in a separate process."""
    paths = [Path(dvax.__file__).parents[1], Path(__file__).parents[1]]
    done = subprocess.run(
        [sys.executable, str(module.__file__)], capture_output=True, text=True, timeout=600,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def is_a_good_refusal(answer: tuple[str, str], words: str) -> None:
    """Assert an `InputError` with all the words, and with place and fix in every line."""
    kind, message = answer
    assert kind == "InputError", message
    for word in words.split("; "):
        assert word in re.sub(r"line \d+", "line", message), message
    for line in message.splitlines():
        assert len(line) < 1000, "one problem a line, and a line of values at most"
        place, _, rest = line.partition(": got ")
        assert place and "; " in rest, "place: got what; the rule. The fix"
