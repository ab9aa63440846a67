"""Whole processes: the cold start of the command line, and the demo."""

import sys
import tempfile
from pathlib import Path

from ..clock import spread
from ..program import dvax
from ..program import run as start
from ..section import Comparison, Section, Target

_HELP_SECONDS = 1.0
_DEMO_SECONDS = 20.0


def run(full: bool) -> Section:
    section = Section(
        title="processes: dvax --help and dvax demo",
        fair=(
            "Wall time of the whole process, interpreter and imports included; for the demo also "
            "compilation, certificate, results on disk and the report. 'other' is the interpreter "
            "that does nothing. The demo's target is that of dvax run on its configuration, which "
            "is what it does."
        ),
    )
    with tempfile.TemporaryDirectory(prefix="dvax-bench-") as name:
        folder = Path(name)
        idle, helped, rounds = [], [], 15 if full else 9
        for _ in range(rounds):
            idle.append(start([sys.executable, "-c", "pass"], folder).seconds)
            helped.append(dvax(["--help"], folder).seconds)
        section.comparisons.append(_row("dvax --help", helped, _HELP_SECONDS, spread(idle).middle))
        out = folder / "demo"
        shown = [
            dvax(["demo", "-o", str(out), "--force", "--quiet"], folder)
            for _ in range(5 if full else 3)
        ]
    section.comparisons.append(
        _row("dvax demo", [ended.seconds for ended in shown], _DEMO_SECONDS, None)
    )
    section.notes.append(
        f"dvax demo keeps the cores busy for {spread([e.worked for e in shown]).middle:.1f} s of "
        "processor time in all: on a machine that does nothing else, its wall time lies between "
        "that divided by the cores and that."
    )
    return section


def _row(case: str, seconds: list[float], most: float, idle: float | None) -> Comparison:
    middle = spread(seconds).middle
    return Comparison(
        case=f"{case}, {len(seconds)} times",
        versus="-" if idle is None else "python -c pass",
        dvax=middle,
        other=idle,
        target=Target("≤", most, middle, " s"),
        rounds=len(seconds),
    )
