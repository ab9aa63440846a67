"""The state of a run directory after a kill or on a full disk."""

import json
import os
import resource
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import xarray
from tests.app.plots.synthetic import Recipe, write_run
from typer.testing import CliRunner

from dvax.app.cli.program import app
from dvax.app.runs.rundir import FrameStore, close_killed, process, write_whole


@contextmanager
def room_for(size: int):
    """Limit files to `size` bytes, which acts like a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_failed_write_keeps_the_old_file_and_leaves_no_part(
    tmp_path: Path,
) -> None:
    file = tmp_path / "summary.json"
    write_whole(file, b"old")
    with room_for(1000), pytest.raises(OSError) as caught:
        write_whole(file, b"x" * 100_000)
    assert caught.value.filename == str(file)
    assert file.read_text() == "old" and os.listdir(tmp_path) == ["summary.json"]


@pytest.mark.slow
@pytest.mark.parametrize("stills", [True, False])
def test_report_on_a_full_disk_names_path_and_fix(
    tmp_path: Path, stills: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,), frames=21))
    before = set(os.listdir(run_dir))
    if not stills:
        monkeypatch.setattr("dvax.app.plots.report._pictures", lambda run: ([], []))
    with room_for(3000):
        result = CliRunner().invoke(app, ["report", str(run_dir)])
    assert result.exit_code == 5, result.output
    place = run_dir / ("figures" if stills else "report.html")
    assert str(place) in result.stderr and "MiB are free there" in result.stderr
    assert "Free some space" in result.stderr and "Make it accessible" not in result.stderr
    assert set(os.listdir(run_dir)) - before <= {"figures"}
    assert not list(run_dir.rglob("*.part")) and not list(run_dir.rglob("*.png"))


def store_of(folder: Path, frames: int) -> FrameStore:
    place = np.linspace(0.0, 1.0, 4)
    return FrameStore(
        folder / "trajectory.zarr", frames, 2, {"s": (("point",), place, {"units": "m"})},
        {"pressure": (("time", "point"), np.float64, {}), "bound": (("time",), np.float64, {})},
        {}, {"units": "s"},
    )  # fmt: skip


def block(first: int, count: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    times = np.arange(first, first + count, dtype=float)
    return times, {"pressure": times[:, None] + np.arange(4.0), "bound": times}


@pytest.mark.parametrize("blocks", [0, 1, 3])
def test_run_directory_shows_only_complete_frames_at_any_time(tmp_path: Path, blocks: int) -> None:
    store = store_of(tmp_path, 41)
    for k in range(blocks):
        store.write(*block(2 * k, 2))
    with xarray.open_zarr(store.path, chunks=None, decode_times=False) as seen:
        assert dict(seen.sizes).get("time", 0) == 2 * blocks
        np.testing.assert_array_equal(seen["time"], np.arange(2.0 * blocks))
        np.testing.assert_array_equal(seen["pressure"][:, 1], np.arange(2.0 * blocks) + 1.0)


def gone() -> int:
    """Return the id of a process that has ended."""
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    return done.pid


def test_close_killed_closes_dead_runs_only(tmp_path: Path) -> None:
    store = store_of(tmp_path, 41)
    store.write(*block(0, 2))
    file = tmp_path / "manifest.json"
    file.write_text(json.dumps({"status": "running", "steps": 3, **process()}))
    assert not close_killed(tmp_path)  # this very process
    assert json.loads(file.read_text())["status"] == "running"
    file.write_text(json.dumps({"status": "running", "steps": 3, **process(), "process": gone()}))
    assert close_killed(tmp_path)
    manifest = json.loads(file.read_text())
    assert manifest["status"] == "killed" and manifest["steps"] == 3
    assert "killed" in manifest["stop_reason"]
    with xarray.open_zarr(store.path, decode_times=False) as seen:
        assert seen.sizes["time"] == 2
    assert not close_killed(tmp_path)
    file.write_text(
        json.dumps({"status": "running", **process(), "process": gone(), "host": "other"})
    )
    assert not close_killed(tmp_path)  # the state of a process on another host is unknown


@pytest.mark.slow
def test_report_of_a_killed_run_states_it(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,), frames=21, written=11, status="running"))
    file = run_dir / "manifest.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | process() | {"process": gone()}))
    result = CliRunner().invoke(app, ["report", str(run_dir)])
    assert result.exit_code == 0, result.output
    page = (run_dir / "report.html").read_text(encoding="utf-8")
    assert "The run was killed before its end." in page
    assert "11 frames" in page
