"""A sampled bound is called estimated in every place, and only proved bounds are called certified."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
from tests.app.cli.contact import write_config
from tests.selection import mostly_thorough
from typer.testing import CliRunner

from dvax.app.cli.program import app

TANK = "C1 1 0 1u IC=10\nL1 1 0 10m\nD1 1 0 R=1k\n"
CIRCUIT = '[model]\nname = "circuit"\nnetlist = "a.cir"\nt_end = "1 ms"\nframes = 20\n'
RECORD = "A record\nof no place\nThe units are (g)\nNPTS= 4, DT= .02 SEC\n 0.0 0.1 -0.1 0.0\n"
FRAME = '[model]\nname = "frame"\nrecord = "a.at2"\nperiod = 0.5\ndamping = 0.05\n'
BODY = '[model]\nname = "fem-contact"\nfine = 2\ncoarse = 2\nlayers = 2\nend = 1.0\nframes = 5\n'


def contact(folder: Path, method: str) -> Path:
    return write_config(folder, ("dt = 0.05", f'dt = 0.05\nmethod = "{method}"'))


def application(text: str) -> Any:
    def write(folder: Path, method: str) -> Path:
        folder.mkdir()
        (folder / "a.cir").write_text(TANK)
        (folder / "a.at2").write_text(RECORD)
        (folder / "a.toml").write_text(f'{text}method = "{method}"\n')
        return folder / "a.toml"

    return write


# Methods of order above 2 are sampled inside a step, those of order 2 enclosed where the law has a
# closed form that an enclosure knows; steps from event to event are sampled.
CASES = [
    (contact, "ETD2RK", "proved"),
    (contact, "ETD4RK", "estimated"),
    (application(CIRCUIT), "PiecewiseLinear", "proved"),
    (application(CIRCUIT), "ETD4RK", "estimated"),
    (application(CIRCUIT), "ETD2RK", "estimated"),
    (application(FRAME), "ETD2RK", "proved"),
    (application(FRAME), "DormandPrince", "estimated"),
    (application(BODY), "ETD4RK", "estimated"),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "method", "status"),
    mostly_thorough(CASES, [CASES[1], CASES[2]]),
)
def test_bound_status_is_shown_in_every_place(
    tmp_path: Path, write: Any, method: str, status: str
) -> None:
    if write is CASES[-1][0]:
        pytest.importorskip("skfem")
    config, out = write(tmp_path / "in", method), tmp_path / "out"
    result = CliRunner().invoke(app, ["run", str(config), "-o", str(out)])
    assert result.exit_code == 0, result.output
    summary = json.loads((out / "summary.json").read_text())
    bounds = {name: entry for name, entry in summary.items() if "error_bound" in name}
    assert len(bounds) >= 1
    with xarray.open_zarr(out / "trajectory.zarr", consolidated=False) as data:
        curves = {name: data[name].attrs["status"] for name in data if "error_bound" in str(name)}
    assert curves
    page = (out / "report.html").read_text(encoding="utf-8")
    # A title, or the label of a panel.
    weak = re.search(r"Error bound[^\n]*, estimated|error bound[^\n]{0,30}\(estimated\)", page)
    if status == "estimated":
        assert set(curves.values()) == {"estimated"}
        assert "Certified error" not in page and weak
    else:
        assert set(curves.values()) <= {"proved", "declared"} and "Certified error" in page
        assert not re.search("Error bound.*, estimated", page)
    assert f'The error bound is <span class="status {status}">' in page
    for name, entry in bounds.items():
        known = entry["bound"]
        if name != "rest_error_bound":  # of the limit at rest, which is solved for by itself
            assert known == next(iter(curves.values()))
        line = next(line for line in result.stdout.splitlines() if line.startswith(f"{name} "))
        assert f"({known})" in entry["meaning"] and f"({known})" in line
        # Two digits, rounded up, on the terminal as on the page; all of them in the file.
        shown = re.search(r"≤ ([-+.e0-9]+)", line)
        assert shown and entry["value"] <= float(shown[1]) <= 1.11 * entry["value"]
        assert f"≤ {shown[1]} " in page and np.isfinite(entry["value"])
