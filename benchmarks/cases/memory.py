"""`dvax run` on 10⁶ points to disk: peak memory and wall time of the whole process."""

import shutil
import tempfile
from pathlib import Path

from ..program import dvax
from ..section import Comparison, Section, Table, Target

_POINTS, _STEPS, _FRAMES = 10**6, 1000, 100
_GIGABYTES = 2.5
_DISK = 8e9
"""Free bytes asked for: three fields of doubles a frame, and room to spare."""

_CONFIG = f"""
[units]
time = "s"
length = "mm"
indentation = "um"
pressure = "MPa"

[model]
name = "contact"
alpha = "1 1/s"
beta = "2 MPa/um"
b_x = 1.0
b_u = 0.5
d_x = "0.2 1/s"
d_u = "0.8 1/s"
kappa0 = "0.6 MPa"

[boundary]
length = "1 mm"
points = {_POINTS}

[demand]
expression = "1 + sin(2*pi*s)"

[load]
expression = "0.5 + 0.2*sin(3*t)"

[initial]
value = 0.0

[time]
end = "1 s"
frames = {_FRAMES}

[solver]
method = "ETD2RK"
dt = "{1 / _STEPS} s"
"""


def run(full: bool) -> Section:
    section = Section(
        title=f"memory: dvax run, {_POINTS:.0e} points, {_STEPS} steps, {_FRAMES} frames on disk",
        fair=(
            "The whole process from its start to its end, compilation, certificate, Zarr store and "
            "report included; peak resident memory as the system counts it. There is no peer."
        ),
    )
    if not full:
        section.skipped = "it writes gigabytes and takes a minute; run with --full"
        return section
    with tempfile.TemporaryDirectory(prefix="dvax-bench-") as name:
        folder = Path(name)
        free = shutil.disk_usage(folder).free
        if free < _DISK:
            section.skipped = (
                f"{free / 1e9:.1f} GB are free in {folder}, and it may need {_DISK / 1e9:g}; set "
                "TMPDIR to a folder with more"
            )
            return section
        config = folder / "field.toml"
        config.write_text(_CONFIG, encoding="utf-8")
        ended = dvax(["run", str(config), "-o", str(folder / "out"), "--quiet"], folder)
        written = sum(f.stat().st_size for f in (folder / "out").rglob("*") if f.is_file())
    section.comparisons.append(
        Comparison(
            case="peak memory of the process (and its time)",
            versus="-",
            dvax=ended.seconds,
            other=None,
            target=Target("≤", _GIGABYTES, ended.peak / 1e9, " GB"),
            rounds=1,
        )
    )
    section.tables.append(
        Table(
            "one run",
            ("peak memory", "wall time", "processor time", "written"),
            [
                (
                    f"{ended.peak / 1e9:.2f} GB",
                    f"{ended.seconds:.1f} s",
                    f"{ended.worked:.1f} s",
                    f"{written / 1e9:.2f} GB",
                )
            ],
        )
    )
    return section
