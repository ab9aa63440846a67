"""The program on mutated input: an exit code of its own, and never a traceback."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from tests.fuzz import cases
from tests.fuzz.seeds import SEEDS, write_folder
from typer.testing import CliRunner

from dvax.app.cli.program import app

pytest.importorskip("skfem")
CODES = {"read": {0, 4}, "refused": {2}}
RUNS = range(4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("program"))


def options(number: int) -> list[str]:
    return ["--allow-code"] if SEEDS[number % len(SEEDS)].allow_code else []


def mutated(number: int, folder: Path) -> tuple[str, Path]:
    """Write mutation `number` of a configuration, and return its verdict and its path."""
    case = cases.configuration(number, folder)
    verdict, _ = case.examine()
    path = folder / f"{number}.toml"
    path.write_bytes(case.content)
    return verdict, path


def check(number: int, folder: Path) -> int:
    verdict, path = mutated(number, folder)
    result = CliRunner().invoke(app, ["check", str(path), *options(number)])
    assert result.exit_code in CODES[verdict], (number, result.output, result.exception)
    assert "Traceback" not in result.output
    return result.exit_code


def process(*arguments: str, seconds: float = 300.0) -> subprocess.CompletedProcess[str] | None:
    """Run the program; None where it takes longer than `seconds`."""
    code = "from dvax.app.cli import main; main()"
    try:
        return subprocess.run(
            [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=seconds,
            check=False, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, errors="replace",
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return None


def test_check_of_mutated_configurations_ends_with_its_exit_codes(folder: Path) -> None:
    assert Counter(check(number, folder) for number in range(26))[2] > 15


def test_name_of_a_configuration_that_is_not_utf8_is_printed(folder: Path) -> None:
    path = os.path.join(os.fsencode(folder), b"a\xff\x1b[31m\n.toml")
    Path(os.fsdecode(path)).write_text("[model]\nalpha = 1.0\n")
    result = CliRunner().invoke(app, ["check", os.fsdecode(path)])
    assert result.exit_code == 2 and "Traceback" not in result.output
    assert "1. a\\udcff\\x1b[31m\\n.toml: model.beta" in result.stderr


@pytest.mark.thorough
@pytest.mark.parametrize("part", range(10))
def test_check_of_many_mutated_configurations(part: int, folder: Path) -> None:
    for number in range(60 + 500 * part, 60 + 500 * (part + 1)):
        check(number, folder)


@pytest.mark.thorough
@pytest.mark.parametrize("part", RUNS)
def test_program_runs_mutated_configurations_without_a_traceback(part: int, folder: Path) -> None:
    """A process each, as a user starts it: some that are refused, and some that run."""
    left = {"read": 10, "refused": 5}
    number = 1000 * part
    while any(left.values()):
        number += 1
        verdict, path = mutated(number, folder)
        if not left[verdict]:
            continue
        left[verdict] -= 1
        out = folder / f"run{number}"
        done = process("run", str(path), "-o", str(out), *options(number), seconds=120.0)
        if done is None:
            continue  # a long run
        expected = {0, 2, 3} if verdict == "read" else {2}
        assert done.returncode in expected, (number, done.returncode, done.stderr)
        assert "Traceback" not in done.stderr, (number, done.stderr)
