"""The time from a signal to the end of a command, for many times of the signal."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ..program import MAIN
from ..section import Comparison, Section, Table, Target

_MOST_SECONDS = 2.0
_NETLIST = "V1 1 0 SIN(0 10 50)\nL1 1 2 1m\nR1 2 3 1\nD1 3 4 R=0.1 G=1u\nC1 4 0 100u\nR2 4 0 100\n"
_TOML = {
    "circuit": '[model]\nname = "circuit"\nnetlist = "a.cir"\nt_end = "200 ms"\nframes = 2000\n',
    "fem-contact": '[model]\nname = "fem-contact"\nfine = 12\ncoarse = 6\nlayers = 8\n',
}
_COMMANDS = {
    "dvax demo": ("demo", "-o", "out"),
    "dvax doctor": ("doctor",),
    **{f"dvax check, {name}": ("check", f"{name}.toml") for name in _TOML},
    **{f"dvax run, {name}": ("run", f"{name}.toml", "-o", "out") for name in _TOML},
}
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# Where this runs in the background of a shell, Ctrl-C is ignored, and what it starts inherits that.
_PROGRAM = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {MAIN}"


def run(full: bool) -> Section:
    section = Section(
        title="signals: from a signal to the end of a command",
        fair=(
            "No peer. Both signals, at times spread over a command: imports, reading, compiling, "
            "solving, writing, drawing. The longest delay counts. A command that had ended by itself "
            "before the signal is left out."
        ),
    )
    times = [0.4 * 1.35**k for k in range(12)] if full else [0.5, 1.5, 3.0, 5.0, 8.0]
    rows = []
    for name, words in _COMMANDS.items():
        delays = [
            (late, at, number.name)
            for at in times
            for number in _SIGNALS
            if (late := _delay(words, at, number)) is not None
        ]
        if not delays:
            continue
        worst, at, number = max(delays)
        rows.append((name, f"{worst:.2f} s", f"{at:.1f} s, {number}", str(len(delays))))
        section.comparisons.append(
            Comparison(
                case=f"{name}, longest of {len(delays)}",
                versus="-",
                dvax=worst,
                other=None,
                target=Target("≤", _MOST_SECONDS, worst, " s"),
                rounds=len(delays),
            )
        )
    head = ("command", "longest delay", "of the signal at", "signals")
    section.tables.append(Table("Delays", head, rows))
    return section


def _delay(words: tuple[str, ...], at: float, number: signal.Signals) -> float | None:
    """Seconds from the signal to the end; None where the command was over before."""
    with tempfile.TemporaryDirectory(prefix="dvax-bench-") as name:
        folder = Path(name)
        (folder / "a.cir").write_text(_NETLIST)
        for model, text in _TOML.items():
            (folder / f"{model}.toml").write_text(text)
        command = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *words], cwd=folder, env=dict(os.environ),
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            command.wait(at)
            return None
        except subprocess.TimeoutExpired:
            command.send_signal(number)
            start = time.perf_counter()
            command.wait()
            return time.perf_counter() - start
