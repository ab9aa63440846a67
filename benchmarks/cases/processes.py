"""Whole processes: the cold start of the command line, and the demo."""

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
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
            "is what it does. Python finds its modules compiled to bytecode, as an installer or the "
            "first start leaves them: the demo ran once before, unmeasured."
        ),
    )
    with tempfile.TemporaryDirectory(prefix="dvax-bench-") as name:
        folder = Path(name)
        with _bytecode(folder / "bytecode"):
            _measure(section, folder, full)
    return section


def _measure(section: Section, folder: Path, full: bool) -> None:
    out = folder / "demo"
    demo = ["demo", "-o", str(out), "--force", "--quiet"]
    dvax(demo, folder)
    idle, helped, rounds = [], [], 15 if full else 9
    for _ in range(rounds):
        idle.append(start([sys.executable, "-c", "pass"], folder).seconds)
        helped.append(dvax(["--help"], folder).seconds)
    section.comparisons.append(_row("dvax --help", helped, _HELP_SECONDS, spread(idle).middle))
    shown = [dvax(demo, folder) for _ in range(5 if full else 3)]
    section.comparisons.append(
        _row("dvax demo", [ended.seconds for ended in shown], _DEMO_SECONDS, None)
    )
    section.notes.append(
        f"dvax demo keeps the cores busy for {spread([e.worked for e in shown]).middle:.1f} s of "
        "processor time in all: on a machine that does nothing else, its wall time lies between "
        "that divided by the cores and that."
    )


@contextmanager
def _bytecode(folder: Path) -> Iterator[None]:
    """Let programs started meanwhile keep compiled modules in `folder`.

    Where PYTHONDONTWRITEBYTECODE is set and the installer compiled nothing, every start compiles
    2000 files anew: a quarter of the demo's time, and no part of dvax.
    """
    names = ("PYTHONPYCACHEPREFIX", "PYTHONDONTWRITEBYTECODE")
    before = {name: os.environ.pop(name, None) for name in names}
    os.environ["PYTHONPYCACHEPREFIX"] = str(folder)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


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
