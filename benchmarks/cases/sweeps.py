"""Sweeps: two workers beside one, and the cost of a member that computes nothing."""

import os
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from dvax.app.runs.sweeps import workers
from dvax.app.runs.sweeps.driver import run_sweep
from dvax.app.runs.sweeps.sweep import Sweep, read_sweep

from ..section import Section, Table, compare

_WORKERS, _OVERHEAD = 1.8, 20.0
_CONFIG = """
[model]
alpha = 1.0
beta = 2.0
b_x = 0.8
b_u = 0.6
d_x = 0.3
d_u = 0.5
kappa0 = 2.0

[boundary]
length = 20.0
points = 2000

[demand]
expression = "(1 + 0.5*cos(pi*s/20))*(1 - 0.4*exp(-t/4))"

[load]
expression = "sin(t) + 0.3*cos(pi*s/20)"

[time]
end = 40.0
frames = 100

[solver]
method = "ETD2RK"
dt = 0.004
"""


def run(full: bool) -> Section:
    members = 200 if full else 40
    section = Section(
        title=f"sweeps: {members} runs of the contact law, and members that compute nothing",
        fair=(
            "dvax sweep with one worker and with two, each with one thread, in turn: 2 000 points, "
            "10 000 steps a member. Time counts from the end of the first two members, which compile, "
            "to the end of the last. A stub in the place of the member gives the cost of Dask alone."
        ),
    )
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        sweep = _sweep(place, members)
        taken: dict[int, list[float]] = {1: [], 2: []}
        for number in range(3 if full else 1):
            for count in taken:
                taken[count].append(_seconds(sweep, place / f"{number}-{count}", count))
        section.comparisons.append(
            compare(
                f"{members} members, time of a member", "one worker", taken[2], taken[1],
                direction="other/dvax", target=("≥", _WORKERS),
            )
        )  # fmt: skip
        section.tables.append(_stubs(place, (1_000, 10_000) if full else (250, 1_000)))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    section.notes.append(f"{cores} cores are there for the workers, the driver and the disk.")
    return section


def _sweep(place: Path, members: int) -> Sweep:
    (place / "contact.toml").write_text(_CONFIG)
    file = place / f"sweep-{members}.toml"
    file.write_text(
        'config = "contact.toml"\n[grid]\n'
        f'"model.b_x" = {{ from = 0.1, to = 0.9, count = {members} }}\n'
        "[output]\nvariables = []\nreport = false\n"
    )
    return read_sweep(file)


def _seconds(sweep: Sweep, out: Path, count: int) -> float:
    """Return the seconds a member, from the end of the second one to that of the last."""
    ends: list[float] = []

    def note(event: Any) -> None:
        if event["event"] == "member":
            assert event["status"] in ("finished", "solved"), event
            ends.append(time.perf_counter())

    run_sweep(sweep, out, workers=count, tell=note)
    return (ends[-1] - ends[1]) / (len(ends) - 2)


def _stub(
    source: str, directory: str, member: int, allow_outside: bool, allow_code: bool
) -> dict[str, Any]:
    """A member that is finished at once."""
    return {"member": member, "status": "finished", "exit_code": 0}


def _stubs(place: Path, counts: tuple[int, ...]) -> Table:
    real, rows = workers.run_task, []
    workers.run_task = _stub
    try:
        for count in counts:
            sweep = _sweep(place, count)
            with workers.cluster(None, 2, 1) as client:
                list(workers.results(client, sweep, place, range(2)))
                start = time.perf_counter()
                ended = list(workers.results(client, sweep, place, range(count)))
                each = 1e3 * (time.perf_counter() - start) / count
            assert sorted(record["member"] for record in ended) == list(range(count))
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            start = time.perf_counter()
            np.array([len(sweep.hash(k)) for k in range(count)])
            hashes = 1e3 * (time.perf_counter() - start) / count
            rows.append(
                (
                    str(count),
                    f"{each:.2f} ms",
                    f"≤ {_OVERHEAD:g} ms",
                    f"{hashes:.2f} ms",
                    f"{peak:.0f} MiB",
                )
            )
    finally:
        workers.run_task = real
    head = ("members", "Dask, a member", "target", "hash, a member", "largest memory of the driver")
    return Table("Members that compute nothing, two workers", head, rows)
