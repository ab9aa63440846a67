"""`dvax export`: files of every format hold the values of the run, with names and units."""

import base64
import csv
import json
import os
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import xarray
import zarr
from tests.app.plots.synthetic import Recipe, write_run
from typer.testing import CliRunner

from dvax.app.cli.program import app
from dvax.app.plots.store import Variable
from dvax.app.runs.applications import base
from dvax.app.runs.applications.run import open_store
from dvax.app.runs.export import FORMATS, csv_files, export_run, netcdf, selection
from dvax.errors import InputError

ENDINGS = {"netcdf": ".nc", "csv": ".csv", "npz": ".npz", "parquet": ".parquet", "vtk": ".pvd"}


@pytest.fixture(scope="module")
def strip(tmp_path_factory) -> Path:
    """A run of the contact law on 60 points with 12 frames."""
    return write_run(tmp_path_factory.mktemp("strip") / "run", Recipe((60,), frames=12))


@pytest.fixture(scope="module")
def own(tmp_path_factory) -> Path:
    """A run of another model: series, a vector, a table without time, a number, a unit in brackets."""
    folder = tmp_path_factory.mktemp("own") / "run"
    folder.mkdir()
    times = np.linspace(0.0, 1.0, 5)
    vector = np.array([[1.5, np.nan, 3e-7]]) * np.arange(1.0, 6.0)[:, None]
    rows = {
        "time": base.Variable(("time",), times, "", "time"),
        "depth": base.Variable(("time",), times**2, "mm", "the depth"),
        "x": base.Variable(("time", "x_0"), vector, "[p]", "a vector"),
    }
    fixed = {
        "cells": base.Variable(("cell", "corner"), np.arange(6).reshape(2, 3), "1", "corners"),
        "least": base.Variable((), np.asarray(2.5), "trip cost", "a number"),
    }
    attrs = {"title": "own", "model": "python"}
    store = open_store(folder / "trajectory.zarr", len(times), rows, fixed, attrs)
    store.write(times, {name: v.values for name, v in rows.items() if name != "time"})
    store.finish()
    about = {"status": "finished", "model": "python", "dvax": "0.1.0"}
    (folder / "manifest.json").write_text(json.dumps(about))
    return folder


def stored(run: Path) -> xarray.Dataset:
    with xarray.open_zarr(run / "trajectory.zarr", consolidated=False) as data:
        return data.load()


def rows_of(path: Path) -> list[list[str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def array_of(element: ET.Element) -> np.ndarray:
    """The values of a VTK DataArray: base64 of their length in bytes and the numbers."""
    kinds = {"Float64": "<f8", "Int64": "<i8", "Int8": "i1"}
    raw = base64.b64decode(str(element.text))
    assert int.from_bytes(raw[:8], "little") == len(raw) - 8
    return np.frombuffer(raw[8:], kinds[element.attrib["type"]])


@pytest.mark.parametrize("name", ["strip", "own"])
def test_netcdf_opens_in_xarray_with_equal_values_and_cf_attributes(
    name, request, tmp_path, monkeypatch
):
    run = request.getfixturevalue(name)
    if name == "own":  # batches of one variable
        monkeypatch.setattr(netcdf, "_BATCH_BYTES", 1)
    (path,) = export_run(run, tmp_path / "a.nc")
    data = stored(run)
    with xarray.open_dataset(path, engine="h5netcdf") as found:
        assert set(found.variables) == set(data.variables)
        for variable in data.variables:
            assert found[variable].dtype == data[variable].dtype
            np.testing.assert_array_equal(found[variable], data[variable])
            assert found[variable].attrs["long_name"]
        assert found.attrs["Conventions"] == "CF-1.11" and found.attrs["title"]
        assert found.attrs["source"].startswith("dvax 0.1.0, model ")
        assert "dvax" in found.attrs["history"]
        units = {n: found[n].attrs["units"] for n in found.variables}
    if name == "strip":
        assert (units["time"], units["pressure"], units["regime"]) == ("s", "MPa", "1")
        assert set(found.coords) == {"time", "s", "weight"}
        assert len(found.attrs["config_sha256"]) == 64
    else:
        assert (units["time"], units["depth"], units["cells"]) == ("1", "mm", "1")


def test_variables_keep_the_order_of_the_model_whatever_their_names(tmp_path):
    names = ["tank two", "tank one", "inflow"]
    time = base.Variable(("time",), np.arange(2.0), "s", "time")
    rows = {"time": time, **{n: base.Variable(("time",), np.ones(2), "m", n) for n in names}}
    (tmp_path / "run").mkdir()
    store = open_store(tmp_path / "run" / "trajectory.zarr", 2, rows, {}, {})
    store.write(time.values, {name: rows[name].values for name in names})
    store.finish()
    (tmp_path / "run" / "manifest.json").write_text(json.dumps({"status": "finished"}))
    (path,) = export_run(tmp_path / "run", tmp_path / "a.csv")
    assert rows_of(path)[0] == ["time [s]", *(f"{name} [m]" for name in names)]


def test_npz_has_the_arrays_and_their_units_without_pickle(own, tmp_path):
    (path,) = export_run(own, tmp_path / "a.npz")
    data = stored(own)
    with np.load(path, allow_pickle=False) as found:
        assert set(found) == {*map(str, data.variables), "metadata"}
        for name in data.variables:
            np.testing.assert_array_equal(found[name], data[name])
            assert found[name].dtype == data[name].dtype
        about = json.loads(str(found["metadata"]))
    assert about["variables"]["depth"] == {
        "long_name": "the depth",
        "units": "mm",
        "dims": ["time"],
    }
    assert about["attributes"]["title"] == "own"


def test_csv_has_a_column_for_every_entry_with_its_unit(own, tmp_path):
    paths = export_run(own, tmp_path / "a.csv")
    assert [p.name for p in paths] == ["a.csv", "a-cell.csv", "a-numbers.csv"]
    head, *rows = rows_of(paths[0])
    assert head == ["time", "depth [mm]", "x[0] [p]", "x[1] [p]", "x[2] [p]"]
    data = stored(own)
    assert [row[3] for row in rows] == [""] * 5  # NaN
    np.testing.assert_array_equal([float(row[1]) for row in rows], data["depth"])
    np.testing.assert_array_equal([float(row[4]) for row in rows], data["x"][:, 2])
    assert rows_of(paths[1])[:2] == [
        ["cell", "cells[0]", "cells[1]", "cells[2]"],
        ["0", "0", "1", "2"],
    ]
    assert rows_of(paths[2]) == [["least [trip cost]"], ["2.5"]]


def test_csv_puts_wide_variables_into_tables_of_their_own(strip, tmp_path):
    paths = export_run(strip, tmp_path / "tables", format="csv")
    names = {p.stem for p in paths}
    assert names == {"time", "point", "pressure", "indentation", "regime"}
    head, *rows = rows_of(tmp_path / "tables" / "pressure.csv")
    assert head[:3] == ["time [s]", "pressure[0] [MPa]", "pressure[1] [MPa]"]
    table = np.array(rows, float)
    np.testing.assert_array_equal(table[:, 1:], stored(strip)["pressure"])
    np.testing.assert_array_equal(table[:, 0], stored(strip)["time"])
    assert rows_of(tmp_path / "tables" / "point.csv")[0] == ["point", "s [mm]", "weight [mm]"]


def test_csv_names_tables_that_no_spreadsheet_opens(strip, monkeypatch, tmp_path):
    monkeypatch.setattr(csv_files, "_SPREADSHEET", 40)
    told: list[str] = []
    export_run(strip, tmp_path / "tables", format="csv", say=told.append)
    assert any("The table pressure has 61 columns" in text for text in told)


def test_parquet_has_lists_of_fixed_length_and_units_in_the_fields(own, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra dvax[parquet] is missing")
    paths = export_run(own, tmp_path / "a.parquet")
    table = parquet.read_table(paths[0])
    assert table.column_names == ["time", "depth", "x"]
    field = table.schema.field("x")
    assert field.metadata[b"units"] == b"[p]" and json.loads(field.metadata[b"shape"]) == [3]
    np.testing.assert_array_equal(np.stack(table["x"].to_numpy()), stored(own)["x"])
    assert table.schema.metadata[b"title"] == b"own"
    assert parquet.read_table(paths[1]).column_names == ["cell", "cells"]


def test_parquet_without_pyarrow_names_the_extra(own, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"pip install 'dvax\[parquet\]'"):
        export_run(own, tmp_path / "a.parquet")


def test_vtk_of_a_line_is_a_polyline_with_the_fields_of_each_frame(strip, tmp_path):
    (path,) = export_run(strip, tmp_path / "a.pvd")
    frames = ET.parse(path).getroot().findall(".//DataSet")
    data = stored(strip)
    assert [float(f.attrib["timestep"]) for f in frames] == data["time"].values.tolist()
    last = ET.parse(tmp_path / frames[-1].attrib["file"]).getroot()
    arrays = {a.attrib["Name"]: array_of(a) for a in last.iter("DataArray")}
    for name in ("pressure", "indentation", "regime"):
        np.testing.assert_array_equal(arrays[name], data[name][-1])
    np.testing.assert_array_equal(arrays["points"].reshape(-1, 3)[:, 0], data["s"])
    assert arrays["connectivity"].tolist() == list(range(60)) and arrays["offsets"].tolist() == [60]


def test_vtk_of_a_rectangle_counts_its_first_coordinate_fastest(tmp_path):
    run = write_run(tmp_path / "run", Recipe((5, 3), frames=2))
    (path,) = export_run(run, tmp_path / "a.pvd")
    grid = ET.parse(tmp_path / "a-frames" / "frame-1.vtr").getroot()
    assert path.is_file() and grid[0].attrib["WholeExtent"] == "0 4 0 2 0 0"
    arrays = {a.attrib["Name"]: array_of(a) for a in grid.iter("DataArray")}
    data = stored(run)
    np.testing.assert_array_equal(
        arrays["pressure"].reshape(3, 5).T, data["pressure"].values[1].reshape(5, 3)
    )
    np.testing.assert_array_equal(arrays["x"], data["s1"].values.reshape(5, 3)[:, 0])
    np.testing.assert_array_equal(arrays["y"], data["s2"].values.reshape(5, 3)[0])


def test_vtk_of_a_run_without_fields_is_refused_with_another_format(own, tmp_path):
    with pytest.raises(InputError, match="model python with depth, x.*Write NetCDF or CSV"):
        export_run(own, tmp_path / "a.pvd")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("format", ["csv", "npz", "parquet", "vtk"])
def test_blocks_of_rows_do_not_change_a_file(strip, tmp_path, monkeypatch, format):
    """Values are read in blocks; the smallest possible ones give the same bytes."""
    if format == "parquet":
        pytest.importorskip("pyarrow", reason="the extra dvax[parquet] is missing")
    fixed = {"Conventions": "CF-1.11"}
    monkeypatch.setattr(selection, "_attributes", lambda run: fixed)
    export_run(strip, tmp_path / f"whole{ENDINGS[format]}")
    monkeypatch.setattr(selection, "_BLOCK_BYTES", 1)
    monkeypatch.setattr(Variable, "frames_per_chunk", 1)
    export_run(strip, tmp_path / f"small{ENDINGS[format]}")
    if format in ("csv", "vtk"):
        for path in tmp_path.rglob("whole*"):
            other = path.with_name(path.name.replace("whole", "small"))
            if path.is_file():
                assert path.read_text().replace("whole", "small") == other.read_text()
    elif format == "npz":
        with np.load(tmp_path / "whole.npz") as a, np.load(tmp_path / "small.npz") as b:
            assert all(np.array_equal(a[n], b[n]) for n in a)
    elif format == "parquet":
        from pyarrow import parquet

        a, b = (parquet.read_table(tmp_path / f"{n}.parquet") for n in ("whole", "small"))
        assert a.equals(b)


def test_block_of_a_table_is_as_long_as_a_chunk_of_its_widest_variable(tmp_path, monkeypatch):
    """A series in one chunk does not make a block of all frames."""
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=3)
    wide = group.create_array("x", shape=(100, 50), chunks=(4, 50), dtype="f8")
    long = group.create_array("t", shape=(100,), chunks=(100,), dtype="f8")
    monkeypatch.setattr(selection, "_BLOCK_BYTES", 10 * 51 * 8)
    found = list(selection.blocks([Variable(long, None), Variable(wide, None)], 100))
    assert found[0] == slice(0, 12) and found[-1] == slice(96, 100)


def test_incomplete_frames_are_left_out_and_named(tmp_path):
    """A killed run: the time of a frame is NaN until the frame is complete."""
    run = write_run(tmp_path / "run", Recipe((7,), frames=6, status="running"))
    zarr.open_group(run / "trajectory.zarr", mode="r+")["time"][4:] = np.nan
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    told: list[str] = []
    for format in FORMATS:
        if format != "parquet":
            export_run(run, tmp_path / f"a{ENDINGS[format]}", say=told.append)
    assert any("2 of 6 frames" in text for text in told)
    assert any(
        text.startswith("The run had not ended") and "up to time 24" in text for text in told
    )
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as found:
        assert found.sizes["time"] == 4 and found.attrs["status"] == "running"
    assert len(rows_of(tmp_path / "a.csv")) == 5
    assert len(list((tmp_path / "a-frames").iterdir())) == 4
    assert before == {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}


def test_run_without_results_is_refused_with_the_way_on(tmp_path):
    run = write_run(tmp_path / "run", Recipe((7,), frames=6, written=0, status="interrupted"))
    with pytest.raises(InputError, match="no complete frames.*dvax resume"):
        export_run(run, tmp_path / "a.nc")


def test_selected_variables_come_with_their_coordinates(strip, tmp_path):
    export_run(strip, tmp_path / "a.nc", variables=["pressure"])
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as found:
        assert set(found.variables) == {"pressure", "time", "s", "weight"}
    with pytest.raises(InputError, match="Did you mean 'pressure'"):
        export_run(strip, tmp_path / "b.nc", variables=["presure"])


@pytest.mark.parametrize("ending", [".nc", ".csv", ".pvd"])
def test_files_are_replaced_only_by_force_and_nothing_else_is_touched(strip, tmp_path, ending):
    target, other = tmp_path / f"a{ending}", tmp_path / "mine.txt"
    other.write_text("kept")
    export_run(strip, target)
    content = target.read_bytes()
    with pytest.raises(InputError, match="--force"):
        export_run(strip, target)
    assert target.read_bytes() == content
    export_run(strip, target, force=True)
    assert other.read_text() == "kept"
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    if ending == ".pvd":
        (tmp_path / "a-frames" / "notes.txt").write_text("mine")
        with pytest.raises(InputError, match="deletes nothing else"):
            export_run(strip, target, force=True)


def test_folder_may_be_the_working_folder(own, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    export_run(own, Path("."), format="csv")
    assert {p.name for p in tmp_path.iterdir()} == {"time.csv", "cell.csv", "numbers.csv"}


def test_failure_leaves_no_file(strip, tmp_path, monkeypatch):
    """A full disk while the second table is written, say."""

    def full(*given):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(csv_files, "_cells", full)
    with pytest.raises(OSError, match="No space"):
        export_run(strip, tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("target", "options", "words"), [
    ("a.xls", {}, "the ending of a file names the format: .nc for netcdf"),
    ("a", {}, "--format netcdf"),
    ("a.nc", {"format": "csv"}, "the ending .nc is that of netcdf"),
    ("a", {"format": "excel"}, "it is one of netcdf, csv"),
    ("run/manifest.json/a.nc", {}, "is a file"),
])  # fmt: skip
def test_wrong_targets_are_refused(strip, target, options, words):
    with pytest.raises(InputError, match=words):
        export_run(strip, strip.parent / target, **options)


def test_command_prints_the_paths_and_says_what_is_left_out(tmp_path):
    run = write_run(tmp_path / "run", Recipe((7,), frames=6, written=3, status="interrupted"))
    given = [
        "export",
        str(run),
        "-o",
        str(tmp_path / "a.csv"),
        "--variables",
        "pressure, load_mean",
    ]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    assert result.stdout.split() == [str(tmp_path / "a.csv"), str(tmp_path / "a-point.csv")]
    assert "note: The run was interrupted before its end." in result.stderr
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 2 and "--force" in result.stderr
    nothing = CliRunner().invoke(app, ["export", str(tmp_path / "none"), "-o", "a.nc"])
    assert nothing.exit_code == 2 and "no such folder" in nothing.stderr


@pytest.mark.thorough  # writes for some seconds, to be interrupted
def test_interrupted_export_leaves_no_file(tmp_path):
    run = write_run(tmp_path / "run", Recipe((20_000,), frames=200))
    target = tmp_path / "out" / "a.csv"
    command = [sys.executable, "-m", "dvax.app.cli", "export", str(run), "-o", str(target)]
    code = "import sys; sys.argv[0] = 'dvax'\nfrom dvax.app.cli import main\nmain()"
    command = [sys.executable, "-c", code, *command[3:]]
    with subprocess.Popen(command, env=os.environ) as process:
        while not target.parent.is_dir() or not any(target.parent.iterdir()):
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
    assert list(target.parent.iterdir()) == []
