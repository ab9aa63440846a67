"""Ctrl-C during a run: exit code 130 (143 for SIGTERM), no traceback; results are readable."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import xarray as xr
from tests.app.cli.contact import write_config
from tests.selection import mostly_thorough

import dvax


@pytest.mark.parametrize(
    "number", mostly_thorough([signal.SIGINT, signal.SIGTERM], [signal.SIGINT])
)
def test_signal_ends_a_run_with_its_exit_code_and_readable_results(
    tmp_path: Path, number: signal.Signals
) -> None:
    # A million steps: the run is certainly not over when the signal arrives.
    changes = (("dt = 0.05", "dt = 1e-6"), ("frames = 8", "frames = 200"))
    config = write_config(tmp_path / "in", *changes)
    # As from a terminal: where the tests themselves run in the background, Ctrl-C is ignored, and what
    # they start inherits that.
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from dvax.app.cli import main; main()"
    )
    out = tmp_path / "out"
    source = str(Path(dvax.__file__).parents[1])
    run = subprocess.Popen(
        [
            sys.executable,
            "-c",
            program,
            "run",
            str(config),
            "-o",
            str(out),
        ],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": source},
    )
    assert run.stderr is not None
    said = []
    for line in run.stderr:
        said.append(line)
        if line.startswith("t = "):
            run.send_signal(number)
            break
    _, rest = run.communicate(timeout=120)
    text = "".join(said) + rest
    assert run.returncode == (130 if number == signal.SIGINT else 143), text
    assert "Traceback" not in text
    assert "interrupted: " in text
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["status"] == "interrupted"
    frames = xr.open_zarr(out / "trajectory.zarr", consolidated=False, chunks=None)
    assert 1 < frames.sizes["time"] < 201
    assert not frames["pressure"].isnull().any()
    if not (out / "report.html").exists():
        # A busy machine has no time for the page before the command must end.
        assert f"for its report: dvax report {out}" in text
        subprocess.run([sys.executable, "-m", "dvax", "report", str(out)], check=True)
    assert "Partial results." in (out / "report.html").read_text(encoding="utf-8")
