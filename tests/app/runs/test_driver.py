"""Runs: their bounds hold, and the files of a run directory agree with each other."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from dvax.app.runs.config import load_config
from dvax.app.runs.driver import run

EL_CENTRO = Path(__file__).parents[4] / "shared" / "data" / "elCentro.at2"

STRIP = """
[units]
length = "mm"
indentation = "um"
pressure = "MPa"
[model]
alpha = "1 1/s"
beta = "2 MPa/um"
b_x = 0.8
b_u = 0.6
d_x = "0.3 1/s"
d_u = "0.5 1/s"
kappa0 = "0.6 MPa"
[boundary]
length = "20 mm"
points = 60
[demand]
expression = "0.5 + 0.5*sin(pi*s/5)"
[load]
{load}
[time]
end = "{end} s"
frames = 40
[solver]
{solver}
"""


def solved(folder: Path, load: str, end: float, solver: str) -> tuple[xr.Dataset, dict, dict]:
    folder.mkdir(exist_ok=True)
    config = folder / "strip.toml"
    config.write_text(STRIP.format(load=load, end=end, solver=solver))
    out = folder / "out"
    outcome = run(load_config(config), out)
    assert outcome.status == "finished" and outcome.exit_code == 0
    frames = xr.open_zarr(out / "trajectory.zarr", consolidated=False, chunks=None)
    return frames, outcome.summary, json.loads((out / "manifest.json").read_text())


def distance(frames: xr.Dataset, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sqrt(((a - b) ** 2) @ frames["weight"].values)


def assert_what_every_run_promises(frames: xr.Dataset) -> None:
    assert frames["error_bound_x"].attrs["status"] == "proved"
    assert np.all(frames["separation_x"] <= frames["separation_bound_x"])
    assert np.all(frames["separation_x"] <= frames["separation_sharp_x"])
    assert np.all(frames["separation_u"] <= frames["separation_bound_u"])
    assert float(frames["pressure"].min()) >= 0.0
    assert float(frames["pressure"].max()) <= 0.6 * (1 + 1e-12)
    assert set(np.unique(frames["regime"])) == {0, 1, 2}


@pytest.mark.thorough
def test_run_bound_covers_the_distance_to_a_fine_run(tmp_path: Path):
    load = 'expression = "2*sin(3*t)"'
    coarse, _, _ = solved(tmp_path / "coarse", load, 6.0, 'dt = "0.05 s"')
    fine, _, _ = solved(tmp_path / "fine", load, 6.0, "rtol = 1e-9")
    for frames in (coarse, fine):
        assert_what_every_run_promises(frames)
    x, p = (distance(coarse, coarse[n].values, fine[n].values) for n in ("indentation", "pressure"))
    for name, found in (("error_bound_x", x), ("error_bound_sharp_x", x), ("error_bound_u", p / 2)):
        bound = coarse[name].values + fine[name.replace("sharp_", "")].values
        assert np.all(found <= bound), name
        print(f"{name}: at most {np.max(found[1:] / bound[1:]):.2f} of its bound")


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["ETD4RK", "ExpRosenbrock", "DormandPrince"])
def test_run_with_every_method_has_a_bound(tmp_path: Path, method: str):
    load = 'expression = "2*sin(3*t)"'
    runs = {
        name: solved(tmp_path / name, load, 6.0, f'dt = "{dt} s"\nmethod = "{name}"')[0]
        for name, dt in ((method, 0.05), ("ETD2RK", 0.005))
    }
    frames = runs[method]
    assert frames["error_bound_x"].attrs["status"] == "estimated"
    apart = distance(frames, frames["indentation"].values, runs["ETD2RK"]["indentation"].values)
    bound = frames["error_bound_x"].values + runs["ETD2RK"]["error_bound_x"].values
    assert np.all(apart <= bound)


def test_run_summary_and_manifest_agree_with_the_frames(tmp_path: Path):
    frames, summary, manifest = solved(tmp_path / "run", 'value = "0.3 um/s"', 2.0, "rtol = 1e-6")
    force = frames["pressure"].values @ frames["weight"].values
    assert summary["peak_force"]["value"] == pytest.approx(force.max())
    assert summary["final_force"]["unit"] == "MPa mm"
    assert manifest["frames"] == len(frames["time"]) == 41
    assert manifest["precision"] == "float64" and manifest["status"] == "finished"
    assert frames["time"].attrs["units"] == "s" and frames["indentation"].attrs["units"] == "um"
    rows = {row["name"]: row for row in manifest["constants"]}
    assert rows["gamma"]["value"] == pytest.approx(1.6 / 2.0)
    assert rows["decay_rate"]["value"] == pytest.approx(1.0 - 0.3 - 0.5 * 0.8 / 1.6)
    assert rows["q_rho"]["value"] == pytest.approx(0.6)  # b_u, at rho = beta


@pytest.mark.thorough
@pytest.mark.skipif(not EL_CENTRO.is_file(), reason="the El Centro record is not on this machine")
def test_run_of_the_strip_under_a_recorded_earthquake(tmp_path: Path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "elCentro.at2").write_bytes(EL_CENTRO.read_bytes())
    load = 'series = { file = "elCentro.at2", per_unit = "30 um/s" }'
    frames, summary, manifest = solved(tmp_path / "run", load, 31.0, 'dt = "0.01 s"')
    assert_what_every_run_promises(frames)
    # 1559 samples, a step never crosses one: at least two steps of 0.01 s a sample.
    assert manifest["steps"] >= 2 * 1550
    assert list(manifest["data"]) == ["elCentro.at2"]
    assert 0 < summary["error_bound_x"]["value"] < 1e-2


@pytest.mark.thorough
def test_run_reports_compilation_before_progress(tmp_path: Path):
    config = tmp_path / "strip.toml"
    # A size of its own: what another test has compiled is not compiled again.
    text = STRIP.format(load='value = "0.3 um/s"', end=1.0, solver='dt = "0.05 s"')
    config.write_text(text.replace("points = 60", "points = 37"))
    heard: list[str] = []
    run(load_config(config), tmp_path / "out", on_event=lambda event: heard.append(event["event"]))
    assert heard[:2] == ["compiled", "progress"]
    assert heard.count("compiled") == 1 and heard[-1] == "stopped"


@pytest.mark.thorough
def test_run_failure_of_the_main_trajectory_shortens_its_companion(tmp_path: Path):
    config = tmp_path / "strip.toml"
    # No number about t = 1.27, which lies between the samples of the check on reading.
    hole = "0.3 + 0*sqrt((t - 1.27)**2 - 1e-4)"
    text = STRIP.format(load=f'expression = "{hole}"', end=2.0, solver='dt = "0.01 s"')
    config.write_text(text)
    out = tmp_path / "out"
    outcome = run(load_config(config), out)
    assert outcome.status == "failed" and outcome.exit_code == 3
    frames = xr.open_zarr(out / "trajectory.zarr", consolidated=False, chunks=None)
    assert 20 < frames.sizes["time"] < 30
    assert np.isfinite(frames["separation_x"]).all()
    assert np.all(frames["separation_x"] <= frames["separation_bound_x"])
