"""The command `dvax explore`: bad input, and its end."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
from tests.app.sweeps.decay import CONFIG, MODEL
from typer.testing import CliRunner

from dvax.app.cli.program import app

PROGRAM = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from dvax.app.cli import main; main()"
)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.toml", None, "no such file or folder"),
        ("broken.toml", "[model\n", "line 1"),
        ("wrong.toml", '[model]\nname = "contract"\n', "contact"),
        ("decay.toml", CONFIG, "--allow-code"),
        ("empty", "", "manifest.json"),
    ],
)
def test_explore_refuses_bad_input(
    tmp_path: Path, name: str, content: str | None, words: str
) -> None:
    (tmp_path / "decay.py").write_text(MODEL)
    target = tmp_path / name
    if name == "empty":
        target.mkdir()
    elif content is not None:
        target.write_text(content)
    result = CliRunner().invoke(app, ["explore", str(target), "--no-browser"])
    assert result.exit_code == 2
    assert words in result.stderr
    assert "Traceback" not in result.output


def test_explore_refuses_a_port_that_is_taken(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        result = CliRunner().invoke(app, ["explore", "--no-browser", "--port", str(port)])
    assert result.exit_code == 2
    assert str(port) in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "number",
    [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.thorough)],
    ids=lambda number: number.name,
)
def test_explore_serves_its_page_and_ends_at_a_signal(number: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "explore", "--no-browser"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ),
    )  # fmt: skip
    try:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert url.startswith("http://127.0.0.1:"), process.communicate()
        with urllib.request.urlopen(f"{url}subject", timeout=30) as answer:
            assert b"Contact law" in answer.read()
        started = time.monotonic()
        process.send_signal(number)
        _, errors = process.communicate(timeout=30)
        assert process.returncode == 0, errors
        assert time.monotonic() - started < 2.0
        assert errors.splitlines()[-1] == "stopped"
    finally:
        process.kill()
        process.communicate()
