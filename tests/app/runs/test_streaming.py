"""Results of applications are written while a run goes on, and memory does not grow with them."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray
from tests.app.runs.test_own_problem import POINT, TABLE
from tests.app.runs.test_resume import circuit, go_on

import dvax
from dvax.app.plots.store import open_store
from dvax.app.runs.applications.certificate import certificate
from dvax.app.runs.applications.config import read_config
from dvax.app.runs.applications.segments import join_pieces, segments
from dvax.app.runs.driver import run
from dvax.app.runs.rundir import FrameStore


def test_trajectory_of_a_run_can_be_read_while_it_goes_on(tmp_path: Path) -> None:
    seen = []

    def read(event) -> None:
        if event["event"] == "progress":
            with xarray.open_zarr(tmp_path / "out" / "trajectory.zarr") as data:
                seen.append(data.load())

    assert run(read_config(circuit(tmp_path)), tmp_path / "out", on_event=read).exit_code == 0
    with xarray.open_zarr(tmp_path / "out" / "trajectory.zarr") as data:
        whole = data.load()
    # Rows are written after each piece (checkpoint_seconds = 0), behind its event.
    lengths = [part.sizes["time"] for part in seen]
    assert lengths == sorted(lengths) and len(set(lengths)) >= 9 and lengths[-1] < 21
    for part in seen:
        xarray.testing.assert_equal(part, whole.isel(time=slice(part.sizes["time"])))


@pytest.mark.parametrize("axis", ["time", "hour"])
def test_rows_without_a_time_are_not_shown(tmp_path: Path, axis: str) -> None:
    store = FrameStore(
        tmp_path / "a.zarr", 9, 4, {}, {"price": ((axis, "firm"), np.float64, {})}, {}, {},
        axis=axis, sizes={"firm": 2},
    )  # fmt: skip
    store.write(np.arange(3.0), {"price": np.ones((3, 2))})
    store._arrays["price"][3:5] = 7.0  # the run is killed here
    found, room = open_store(store.path)
    assert found.count == room == 3  # the metadata end with the last complete row
    assert found.variables["price"].values.tolist() == [[1.0, 1.0]] * 3
    with xarray.open_zarr(store.path) as data:
        assert data.sizes == {axis: 3, "firm": 2}


def test_run_that_is_stopped_while_it_reads_its_checkpoints_keeps_its_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tests.app.runs.test_partial import Stops

    config = read_config(circuit(tmp_path))
    assert run(config, tmp_path / "out", on_event=Stops(4, KeyboardInterrupt())).exit_code == 130
    with xarray.open_zarr(tmp_path / "out" / "trajectory.zarr") as data:
        before = data.load()
    taken, limit = type(config.model).rows, 2

    def stops(self, piece, bound, count):
        nonlocal limit
        limit -= 1
        if limit < 0:
            raise KeyboardInterrupt
        return taken(self, piece, bound, count)

    with monkeypatch.context() as patched:
        patched.setattr(type(config.model), "rows", stops)
        assert go_on(tmp_path / "out").exit_code == 130
    with xarray.open_zarr(tmp_path / "out" / "trajectory.zarr") as data:
        xarray.testing.assert_identical(data.load(), before)
    assert go_on(tmp_path / "out").exit_code == 0


@pytest.mark.slow
def test_bound_of_a_run_in_pieces_is_above_its_error_and_not_above_that_of_the_whole() -> None:
    from tests.app.runs.test_partial import plan_of_the_closed_form

    plan, before, values = plan_of_the_closed_form(41), None, []
    pieces = list(segments(plan))
    for piece in pieces:
        before = certificate(plan.problem, piece, plan.constants, before)
        values.append(before.values)
    whole = certificate(plan.problem, join_pieces(pieces), plan.constants)
    bound = np.concatenate(values)
    assert np.all(bound <= whole.values * (1 + 1e-12)) and before is not None
    assert before.status == whole.status
    assert abs(float(pieces[-1].xs[-1]) - 1.8360919559905713) <= bound[-1]


PEAK = """
import resource, sys
from pathlib import Path
from dvax.app.runs.applications.config import read_config
from dvax.app.runs.driver import run

folder, name = Path(sys.argv[1]), sys.argv[2]
assert run(read_config(folder / f"{name}.toml", allow_code=True), folder / name).exit_code == 0
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
_MEGABYTES = 1024 * (1024 if sys.platform == "darwin" else 1)


@pytest.mark.thorough
def test_memory_of_a_run_does_not_grow_with_the_number_of_frames(tmp_path: Path) -> None:
    """The trajectory of 40 000 frames has 160 MB. (Measured: 44 MB more than of 4000 frames; 650 MB
    when a run kept its solution.)"""
    code = POINT.replace("points: int = 1", "points: int = 250").partition("figures=")[0] + ")\n"
    (tmp_path / "own.py").write_text(code)
    peaks = []
    for frames in (4_000, 40_000):
        config = tmp_path / f"run{frames}.toml"
        table = TABLE.replace("frames = 20", f"frames = {frames}")
        config.write_text(table + "[output]\nreport = false\npng = false\n")
        done = subprocess.run(
            [sys.executable, "-c", PEAK, str(tmp_path), config.stem], capture_output=True, text=True,
            env=os.environ
            | {"JAX_ENABLE_X64": "1", "PYTHONPATH": str(Path(dvax.__file__).parents[1])},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        peaks.append(int(done.stdout) / _MEGABYTES)
    assert peaks[1] - peaks[0] < 100.0, peaks
