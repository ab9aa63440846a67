"""A run directory is an ordinary Zarr store: xarray sees a Dataset with coordinates and units."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dvax.app.runs.rundir import FrameStore

POINTS, FRAMES, BLOCK = 5, 7, 3
PLACE = np.linspace(0.1, 0.9, POINTS)
WEIGHT = np.full(POINTS, 0.2)
VARIABLES: dict[str, Any] = {
    "pressure": (("time", "point"), np.float64, {"units": "MPa", "long_name": "pressure p"}),
    "regime": (("time", "point"), np.int8, {"units": "1", "flag_values": [0, 1, 2]}),
    "error_bound_x": (("time",), np.float64, {"units": "um", "status": "estimated"}),
}


@pytest.fixture
def store(tmp_path: Path) -> FrameStore:
    return FrameStore(
        tmp_path / "trajectory.zarr",
        FRAMES,
        BLOCK,
        {
            "s": (("point",), PLACE, {"units": "mm", "long_name": "place"}),
            "weight": (("point",), WEIGHT, {"units": "mm"}),
        },
        VARIABLES,
        {"title": "strip", "kappa0": 2.0, "boundary_shape": [POINTS], "constants": "[]"},
        {"units": "s", "long_name": "time"},
    )


def opened(store: FrameStore) -> xr.Dataset:
    return xr.open_zarr(store.path, consolidated=False, chunks=None, decode_times=False).load()


def values(count: int, first: int = 0) -> dict[str, np.ndarray]:
    frame = np.arange(first, first + count, dtype=float)
    return {
        "pressure": frame[:, None] + PLACE,
        "regime": np.full((count, POINTS), 2, np.int8),
        "error_bound_x": 1e-6 * frame,
    }


def test_run_directory_has_coordinates_units_and_attributes_for_xarray(store: FrameStore) -> None:
    store.write(np.arange(3.0), values(3))
    frames = opened(store)
    assert set(frames.coords) == {"time", "s", "weight"}
    assert set(frames.data_vars) == set(VARIABLES)
    assert frames["pressure"].dims == ("time", "point")
    np.testing.assert_array_equal(frames["s"], PLACE)
    np.testing.assert_array_equal(frames["weight"], WEIGHT)
    assert frames["s"].attrs == {"units": "mm", "long_name": "place"}
    assert frames["time"].attrs == {"units": "s", "long_name": "time"}
    for name, (_, dtype, meta) in VARIABLES.items():
        assert frames[name].attrs == meta
        assert frames[name].dtype == dtype
    # The list of coordinates is no attribute to xarray, which took it for what it is.
    assert frames.attrs == {
        "title": "strip",
        "kappa0": 2.0,
        "boundary_shape": [POINTS],
        "constants": "[]",
    }


def test_run_directory_store_equals_that_of_xarray(store: FrameStore, tmp_path: Path) -> None:
    fixed = xr.Dataset(coords=opened(store)[["s", "weight"]].coords)
    fixed.to_zarr(tmp_path / "own.zarr", consolidated=False, zarr_format=3)
    for name in ("s", "weight"):
        ours, theirs = (
            json.loads((folder / name / "zarr.json").read_text())
            for folder in (store.path, tmp_path / "own.zarr")
        )
        theirs["attributes"].pop("_FillValue", None)
        assert ours == theirs
        here, there = store.path / name / "c" / "0", tmp_path / "own.zarr" / name / "c" / "0"
        assert here.read_bytes() == there.read_bytes()


def test_frame_has_a_time_only_if_it_is_complete(store: FrameStore) -> None:
    store.write(np.arange(3.0), values(3))
    broken = values(3, first=3)
    del broken["error_bound_x"]
    with pytest.raises(KeyError):
        store.write(np.arange(3.0, 6.0), broken)
    frames = opened(store)
    np.testing.assert_array_equal(frames["time"], [0, 1, 2, *[np.nan] * 4])
    np.testing.assert_array_equal(frames["pressure"][:3], values(3)["pressure"])


def test_marked_and_truncated_frames_are_on_disk(store: FrameStore) -> None:
    store.write(np.arange(3.0), values(3))
    store.mark(("error_bound_x",), "proved")
    store.write(np.array([3.0]), values(1, first=3))
    store.finish()
    frames = opened(store)
    assert dict(frames.sizes) == {"time": 4, "point": POINTS}
    assert frames["error_bound_x"].attrs == {"units": "um", "status": "proved"}
    np.testing.assert_array_equal(frames["pressure"], values(4)["pressure"])


@pytest.mark.slow
def test_run_and_report_do_not_import_xarray_or_pandas() -> None:
    program = (
        "import sys, dvax.app.runs.driver, dvax.app.plots\n"
        "print([name for name in ('xarray', 'pandas') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
