"""Data files of a problem of your own: parameters of type pathlib.Path."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray
from tests.app.runs.test_partial import Stops
from typer.testing import CliRunner

import dvax
from dvax.app.cli.program import app
from dvax.app.runs.applications.config import read_config
from dvax.app.runs.driver import run
from dvax.app.runs.sweeps.sweep import read_sweep

CODE = """
from pathlib import Path
import numpy as np
from pydantic import BaseModel
import dvax

def build(rate: Path, scale: float = 1.0, other: Path | None = None):
    times, values = np.loadtxt(rate, delimiter=",", skiprows=1, unpack=True)
    series = dvax.signals.Table(times, scale * values)
    problem = dvax.Problem(
        A=dvax.generators.Scalar(0.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: series(t) + u, h=lambda t, x, u, args: 0.0 * x,
    )
    return dvax.models.Model(problem, 0.0, 2.0, states={"level": "mm"})

class Files(BaseModel):
    rate: Path

class Parameters(BaseModel):
    files: Files
    scale: float = 1.0

def build_from_model(p: Parameters):
    return build(p.files.rate, p.scale)

def build_from_default(rate: Path = Path("data/rate.csv")):
    return build(rate)

class List(BaseModel):
    rates: list[Path]

def build_from_list(p: List):
    return build(p.rates[0])
"""
DATA = "time,rate\n0,0\n1,3\n2,0\n"
AREA = 3.0
"""The integral of the rate, which is the level at the end."""
TABLE = (
    '[model]\npython = "level.py:build"\nframes = 20\n'
    "[output]\nreport = false\ncheckpoint_seconds = 0\n"
)
NAMED = '[model.parameters]\nrate = "data/rate.csv"\n'


def written(folder: Path, parameters: str = NAMED, function: str = "build") -> Path:
    (folder / "data").mkdir(parents=True)
    (folder / "data" / "rate.csv").write_text(DATA)
    (folder / "level.py").write_text(CODE)
    file = folder / "level.toml"
    file.write_text(TABLE.replace(":build", f":{function}") + parameters)
    return file


def problem(file: Path) -> str:
    with pytest.raises(dvax.InputError) as caught:
        read_config(file, allow_code=True)
    (found,) = caught.value.problems
    return str(found)


@pytest.mark.slow
def test_a_run_goes_on_with_the_copy_of_its_data_from_any_working_directory(tmp_path, monkeypatch):
    folder, elsewhere = tmp_path / "made", tmp_path / "elsewhere"
    elsewhere.mkdir()
    file = written(folder)
    monkeypatch.chdir(elsewhere)
    shown = CliRunner().invoke(app, ["check", str(file), "--allow-code"])
    assert shown.exit_code == 0 and "rate.csv" in shown.stdout
    part = tmp_path / "part"
    stopped = run(read_config(file, allow_code=True), part, on_event=Stops(4, KeyboardInterrupt()))
    assert stopped.status == "interrupted"
    manifest = json.loads((part / "manifest.json").read_text())
    assert set(manifest["data"]) == {"level.py", "rate.csv"}
    assert (part / "inputs" / "model_parameters_rate_rate.csv").read_text() == DATA
    shutil.rmtree(folder)
    result = CliRunner().invoke(app, ["resume", str(part), "--allow-code"])
    assert result.exit_code == 0, result.stderr
    with xarray.open_zarr(part / "trajectory.zarr") as data:
        np.testing.assert_allclose(data.level.values[-1], AREA, rtol=1e-6)


@pytest.mark.slow
def test_a_run_does_not_go_on_with_other_data(tmp_path):
    part = tmp_path / "part"
    config = read_config(written(tmp_path / "made"), allow_code=True)
    run(config, part, on_event=Stops(4, KeyboardInterrupt()))
    copy = part / "inputs" / "model_parameters_rate_rate.csv"
    copy.write_text(DATA.replace("3", "4"))
    result = CliRunner().invoke(app, ["resume", str(part), "--allow-code"])
    assert result.exit_code == 2 and "data of model.parameters.rate" in result.stderr


def test_a_field_of_a_pydantic_model_is_a_data_file(tmp_path):
    table = '[model.parameters.files]\nrate = "data/rate.csv"\n'
    config = read_config(written(tmp_path / "made", table, "build_from_model"), allow_code=True)
    keys = [key for key, _ in config.data_files()]
    assert keys == ["model.python", "model.parameters.files.rate"]
    assert config.tree()["model"]["parameters"]["files"] == {"rate": "data/rate.csv"}


@pytest.mark.parametrize(("parameters", "function", "words"), [
    ('[model.parameters]\nrate = "rate.csv"\n', "build",
     ("level.toml: model.parameters.rate: got 'rate.csv'", "there is no such file", "Put it")),
    ('[model.parameters]\nrate = "../rate.csv"\n', "build", ("--allow-outside",)),
    ('[model.parameters]\nrate = "data"\n', "build", ("it is a folder",)),
    ('[model.parameters]\nrate = 3\n', "build", ("the name of a file in quotes",)),
    ("", "build", ("model.parameters.rate: got nothing", "required")),
    ("", "build_from_default",
     ("the default 'data/rate.csv'", "names every data file", 'Write rate = "rate.csv"')),
    ('[model.parameters]\nrates = ["data/rate.csv"]\n', "build_from_list", ("1 files in a list",)),
])  # fmt: skip
def test_a_wrong_data_file_is_named_with_its_key(tmp_path, parameters, function, words):
    told = problem(written(tmp_path / "made", parameters, function))
    assert all(word in told for word in words), told


def test_a_missing_file_has_its_path_from_the_working_directory(tmp_path, monkeypatch):
    file = written(tmp_path / "made", '[model.parameters]\nrate = "rate.csv"\n')
    monkeypatch.chdir(file.parent)
    assert "Put it at rate.csv or" in problem(file)
    monkeypatch.chdir(tmp_path)
    assert f"Put it at {Path('made/rate.csv')} or" in problem(file)
    monkeypatch.chdir(file.parent / "data")
    assert f"Put it at {file.parent / 'rate.csv'} or" in problem(file)


def test_files_of_one_name_have_their_folders_in_the_manifest(tmp_path):
    file = written(tmp_path / "made", NAMED + 'other = "rate.csv"\n')
    (file.parent / "rate.csv").write_text("other\n")
    found = read_config(file, allow_code=True).fingerprints()
    assert [f.name for f in found] == ["level.py", str(Path("data/rate.csv")), "rate.csv"]


def test_changed_data_of_a_sweep_are_run_again_and_the_file_may_be_swept(tmp_path):
    file = written(tmp_path / "made", "")
    (file.parent / "data" / "more.csv").write_text(DATA.replace("3", "4"))
    sweep = file.with_name("sweep.toml")
    keys = '"model.parameters.rate" = ["data/rate.csv", "data/more.csv"]\n'
    sweep.write_text(f'config = "level.toml"\n[grid]\n{keys}')
    before = read_sweep(sweep, allow_code=True)
    hashes = [before.hash(k) for k in range(2)]
    assert before.config(1).data_files()[1][1].name == "more.csv"
    (file.parent / "data" / "more.csv").write_text(DATA)
    after = read_sweep(sweep, allow_code=True)
    assert [after.hash(k) == h for k, h in enumerate(hashes)] == [True, False]
