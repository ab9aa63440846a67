"""The `dvax` program as a user starts it, with its time and its memory."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

_LAUNCHER = """
import json, os, subprocess, sys, time
started = time.perf_counter()
with open(sys.argv[1], "w") as said:
    child = subprocess.Popen(sys.argv[2:], stdin=subprocess.DEVNULL, stdout=said, stderr=said)
    _, status, usage = os.wait4(child.pid, 0)
ended = time.perf_counter() - started
worked = usage.ru_utime + usage.ru_stime
print(json.dumps([ended, worked, usage.ru_maxrss, os.waitstatus_to_exitcode(status)]))
"""
"""A process of its own between this one and the program: Linux counts the memory of whoever starts
a process as that process's own peak, and this one holds arrays of 10⁶ points."""

MAIN = "from dvax.app.cli import main; main()"


class Ended(NamedTuple):
    """Wall seconds, processor seconds over all cores and peak resident bytes of a process that
    succeeded."""

    seconds: float
    worked: float
    peak: int


def dvax(arguments: Sequence[str], folder: Path) -> Ended:
    """Run `dvax` with these arguments; `folder` receives what it prints.

    **Raises:** `RuntimeError`, with what it printed, where it fails.
    """
    script = Path(sys.executable).with_name("dvax")
    program = [str(script)] if script.is_file() else [sys.executable, "-c", MAIN]
    return run([*program, *arguments], folder)


def run(command: Sequence[str], folder: Path) -> Ended:
    """Run any command to its end; see `dvax`."""
    said = folder / "said.txt"
    launched = subprocess.run(
        [sys.executable, "-I", "-S", "-c", _LAUNCHER, str(said), *command],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if launched.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} could not be started: {launched.stderr[-2000:]}")
    seconds, worked, peak, status = json.loads(launched.stdout)
    if status != 0:
        text = said.read_text(encoding="utf-8", errors="replace")
        raise RuntimeError(f"{' '.join(command)} ended with status {status}: {text[-2000:]}")
    # Kilobytes everywhere but on macOS, which counts bytes.
    return Ended(seconds, worked, peak if sys.platform == "darwin" else 1024 * peak)
