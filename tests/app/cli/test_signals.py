"""Both signals, at many times, in every command: the command ends and leaves readable results."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray
from tests.app.plots.synthetic import Recipe, write_run
from tests.selection import spread

import dvax

TANK = "C1 1 0 1u IC=10\nL1 1 0 10m\nD1 1 0 R=1k\n"
RECORD = "A record\nof no place\nThe units are (g)\nNPTS= 4, DT= .02 SEC\n 0.0 0.1 -0.1 0.0\n"
TOML = {
    "circuit": '[model]\nname = "circuit"\nnetlist = "a.cir"\nt_end = "20 ms"\nframes = 2000\n',
    "frame": (
        '[model]\nname = "frame"\nrecord = "a.at2"\nperiod = 0.5\ndamping = 0.05\n'
        "yield_ratio = 0.5\nviscosity_ratio = 0.001\n"
    ),
    "fem-contact": '[model]\nname = "fem-contact"\nfine = 8\ncoarse = 4\nlayers = 6\n',
}
PROGRAM = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from dvax.app.cli import main; main()"
)
COMMANDS = [("demo", "--points", "2000", "-o", "OUT"), ("doctor",), ("report", "RUN")]
COMMANDS += [("run", name, "-o", "OUT") for name in TOML] + [("check", name) for name in TOML]
TRIALS = [
    (command, seconds, number, twice)
    for command in COMMANDS
    for seconds in (0.5, 1.1, 2.3, 4.7, 7.9, 12.1, 19.3)
    for number in (signal.SIGINT, signal.SIGTERM)
    for twice in (False, True)
]


# `test_interrupt` has one signal in one command for `make test`.
@pytest.mark.thorough
@pytest.mark.parametrize(("command", "seconds", "number", "twice"), spread(TRIALS, 61))
def test_signal_at_any_time_ends_a_command_with_readable_results(
    tmp_path: Path, command: tuple[str, ...], seconds: float, number: signal.Signals, twice: bool
) -> None:
    if "fem-contact" in command:
        pytest.importorskip("skfem")
    out = tmp_path / "out"
    (tmp_path / "a.cir").write_text(TANK)
    (tmp_path / "a.at2").write_text(RECORD)
    for name, text in TOML.items():
        (tmp_path / f"{name}.toml").write_text(text)
    places = {"OUT": str(out)} | {name: f"{name}.toml" for name in TOML}
    if "RUN" in command:
        places["RUN"] = str(write_run(tmp_path / "run", Recipe((30,))))
    run = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *(places.get(word, word) for word in command)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(dvax.__file__).parents[1])},
    )  # fmt: skip
    try:
        _, said = run.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        run.send_signal(number)
        if twice:
            run.send_signal(number)
        # How long it takes is for a machine without other work, and not asserted here.
        _, said = run.communicate(timeout=60)
    # By its own exit, or by the signal itself while Python starts and ends.
    assert run.returncode in (0, 128 + number, -number), said
    assert "Traceback" not in said
    if run.returncode == 128 + number and out.exists():
        manifest = json.loads((out / "manifest.json").read_text())
        assert manifest["status"] in ("interrupted", "finished", "running")
        assert not [*out.rglob("*.part"), *out.rglob("*.new")]
        if (out / "trajectory.zarr").exists():
            with xarray.open_zarr(out / "trajectory.zarr", consolidated=False) as data:
                time = np.asarray(data["time"])
                assert np.isfinite(time[: manifest.get("frames", 0)]).all()
                if manifest["status"] == "interrupted":
                    assert np.isfinite(time).all() and np.all(np.diff(time) > 0)
