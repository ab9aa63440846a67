"""A problem of your own from the command line: `[model] python = "file.py:build"`."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray
from tests.app.plots.page_data import figures_of
from typer.testing import CliRunner

import dvax
from dvax.app.cli.program import app
from dvax.app.plots import build_report
from dvax.app.runs.applications.config import read_config
from dvax.app.runs.driver import run

HEAD = """
from typing import Annotated
import jax.numpy as jnp
import dvax
"""
POINT = (
    HEAD
    + """
def build(load: float = 3.0, limit: Annotated[float, "N"] = 0.5, points: int = 1):
    x0 = -1.0 if points == 1 else jnp.full(points, -1.0)
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, limit),
        f=lambda t, x, u, args: load - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )
    return dvax.models.Model(
        problem, x0, 2.0, states={"depth": "mm"}, responses={"force": "N"}, time_unit="min",
        settings={"rtol": 1e-8},
        figures=lambda sol: {"largest": (jnp.max(sol.us), "N", "the largest force")},
    )
"""
)
TABLE = '[model]\npython = "own.py:build"\nframes = 20\n'


def written(folder: Path, code: str = POINT, table: str = TABLE) -> Path:
    (folder / "own.py").write_text(code)
    (folder / "own.toml").write_text(table)
    return folder / "own.toml"


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    table = TABLE + '[model.parameters]\nload = 2.5\nlimit = "400 mN"\n'
    return run(read_config(written(folder, table=table), allow_code=True), folder / "run")


@pytest.mark.slow
def test_a_run_has_the_variables_of_the_model_by_name_and_unit(outcome):
    assert outcome.exit_code == 0
    data = xarray.open_zarr(outcome.directory / "trajectory.zarr")
    assert set(data.variables) == {"time", "depth", "force", "error_bound"}
    units = {name: data[name].attrs["units"] for name in ("time", "depth", "force")}
    assert units == {"time": "min", "depth": "mm", "force": "N"}
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.4),
        f=lambda t, x, u, args: 2.5 - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip
    alone = dvax.solve(problem, -1.0, 0.0, 2.0, ts=data["time"].values, rtol=1e-10)
    apart = np.abs(data["depth"].values - np.asarray(alone.xs))
    assert apart.max() < 1e-8 and (apart <= data["error_bound"].values).all()
    np.testing.assert_allclose(data["force"], alone.us, atol=1e-8)
    assert outcome.summary["largest"] == {
        "value": 0.4, "unit": "N", "meaning": "the largest force",
    }  # fmt: skip
    assert outcome.summary["final_depth"]["value"] == data["depth"].values[-1]
    # All states have this unit, and so has their norm.
    assert outcome.summary["error_bound"]["unit"] == data["error_bound"].attrs["units"] == "mm"


OSCILLATOR = (
    HEAD
    + """
def build(pull: float = 1.0, opaque: bool = False):
    bend = (lambda v: jnp.fft.irfft(jnp.fft.rfft(v) ** 2, 2)) if opaque else (lambda v: v**2)
    problem = dvax.Problem(
        A=dvax.generators.Scalar(0.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-0.5, 0.5),
        f=lambda t, x, u, args: jnp.stack([x[1], (1.0 - bend(x)[0]) * x[1] - x[0] + u]),
        h=lambda t, x, u, args: -pull * x[1], control_space=dvax.spaces.Euclidean(()),
    )
    return dvax.models.Model(problem, jnp.array([1.0, 0.0]), 6.0, states={"a": "m", "b": "m"})
"""
)


@pytest.mark.slow
@pytest.mark.parametrize("pull", [1.0, 20.0])
def test_a_nonlinear_problem_without_constants_has_a_proved_bound(tmp_path, pull):
    """Van der Pol's oscillator, whose f has no Lipschitz constant."""
    table = TABLE.replace("frames = 20", "frames = 60") + f"[model.parameters]\npull = {pull}\n"
    config = read_config(written(tmp_path, OSCILLATOR, table), allow_code=True)
    found = run(config, tmp_path / "run")
    data = xarray.open_zarr(found.directory / "trajectory.zarr")
    bound = data["error_bound"]
    assert bound.attrs["status"] == "proved" and found.summary["error_bound"]["bound"] == "proved"
    own = config.model.own
    sharp = dict(rtol=1e-12, atol=1e-12, method=dvax.ExpRosenbrock())
    exact = dvax.solve(own.problem, own.x0, 0.0, 6.0, ts=data["time"].values, **sharp)
    apart = np.hypot(data["a"].values - exact.xs[:, 0], data["b"].values - exact.xs[:, 1])
    assert (apart <= bound.values + 1e-11).all()
    assert bound.values.max() <= 10.0 * max(apart.max(), 1e-7)


@pytest.mark.slow
def test_a_problem_whose_code_proves_nothing_says_so_in_its_summary(tmp_path):
    table = TABLE + "[model.parameters]\nopaque = true\n"
    config = read_config(written(tmp_path, OSCILLATOR, table), allow_code=True)
    found = run(config, tmp_path / "run").summary["error_bound"]
    assert not np.isfinite(float(found["value"])) and "alpha_f is not proved" in found["why"]
    table = TABLE.replace("frames = 20", "frames = 20\nbound_steps = 0")
    config = read_config(written(tmp_path, OSCILLATOR, table), allow_code=True)
    found = run(config, tmp_path / "other").summary["error_bound"]
    assert found["bound"] == "estimated" and "larger than any number" in found["why"]


@pytest.mark.slow
def test_the_report_says_that_code_ran_and_draws_the_variables_in_order(outcome):
    page = build_report(outcome.directory).read_text()
    assert "The code of own.py:build is executed." in page
    panels = str(figures_of(page)["histories"]["figure"]["data"])
    assert panels.index("'depth") < panels.index("'force")
    manifest = json.loads((outcome.directory / "manifest.json").read_text())
    assert "own.py" in manifest["data"] and manifest["fit"] == "a problem of your own: own.py"
    assert manifest["title"] == "build, own"


@pytest.mark.thorough
def test_a_run_directory_runs_again(outcome, tmp_path):
    again = run(
        read_config(outcome.directory / "config.resolved.toml", allow_code=True), tmp_path / "again"
    )
    assert again.summary == outcome.summary


@pytest.mark.thorough
def test_arrays_and_a_certified_run(tmp_path):
    table = TABLE + "certify = true\nrtol = 1e-4\n[model.parameters]\npoints = 5\n"
    found = run(read_config(written(tmp_path, table=table), allow_code=True), tmp_path / "run")
    data = xarray.open_zarr(found.directory / "trajectory.zarr")
    assert data["depth"].dims == ("time", "depth_0") and data["depth"].shape == (21, 5)
    assert data["error_bound"].attrs["status"] == "proved"
    build_report(found.directory, stills=False)


def problems(folder, code=POINT, table=TABLE, **options):
    with pytest.raises(dvax.InputError) as caught:
        read_config(written(folder, code, table), **({"allow_code": True} | options))
    return [str(problem) for problem in caught.value.problems]


def test_code_is_not_executed_without_the_flag(tmp_path):
    code = "open('ran', 'w').close()\n" + POINT
    (told,) = problems(tmp_path, code, allow_code=False)
    assert "own.toml: model.python" in told and "--allow-code" in told
    for command in (["check"], ["run", "-o", str(tmp_path / "out")]):
        result = CliRunner().invoke(app, [command[0], str(tmp_path / "own.toml"), *command[1:]])
        assert result.exit_code == 2 and "--allow-code" in result.stderr
    assert not Path("ran").exists() and not (tmp_path / "ran").exists()


@pytest.mark.parametrize(("code", "table", "words"), [
    (POINT, TABLE + "[model.parameters]\nlaod = 1.0\n", "Did you mean 'load'?"),
    (POINT, TABLE + '[model.parameters]\nload = "a"\n', "own.toml: model.parameters.load"),
    (POINT, TABLE + "[model.parameters]\nload = true\n", "it must be a number (a parameter of build)"),
    (POINT, TABLE + '[model.parameters]\nlimit = "3 s"\n', 'Write "2.5 N"'),
    (POINT, TABLE + "t_end = -1.0\n", "model.t_end"),
    (POINT, TABLE + 't_end = "5 mm"\n', 'a unit of time. Write "2.5 min"'),
    (POINT, TABLE + "t_end = [1.0]\n", 'a unit of time. Write "2.5 h", say'),
    (POINT, TABLE.replace(":build", ":biuld"), "It has build"),
    (POINT, '[model]\nname = "python"\n', "it is required"),
    (POINT, TABLE.replace("own.py", "../own.py"), "model.python"),
    (HEAD + "def build(load): pass\n", TABLE, "each parameter has a type"),
    (HEAD + "def build():\n    return 3\n", TABLE, "it must return a dvax.models.Model"),
    (HEAD + "def build():\n    return 1 / 0\n", TABLE, "own.py, line 6: got ZeroDivisionError"),
    ("import dvax\ndef build(:\n", TABLE, "own.py, line 2: got def build"),
    ("import no_such_module\n", TABLE, "own.py, line 1: got ModuleNotFoundError"),
    (POINT.replace('{"depth": "mm"}', '{"a": "", "b": ""}'), TABLE, "a name for each of the 1 entries"),
    (POINT.replace("x0, 2.0", "x0, -2.0"), TABLE, "t0 < t_end"),
    (POINT.replace('{"depth": "mm"}', '{"time": "s"}'), TABLE, "this name is of the results already"),
    (POINT.replace('{"depth": "mm"}', '{"force": "N"}'), TABLE, "stands for two of them"),
    (POINT.replace('{"rtol": 1e-8}', '{"events": []}'), TABLE, "a run has the options method, rtol"),
    (POINT.replace("points: int = 1", "points: int = 'a'"), TABLE, "model.parameters.points"),
    (POINT.replace("load: float", "load: lode"), TABLE, "NameError: name 'lode' is not defined"),
    ("from __future__ import annotations\n" + POINT.replace("load: float", "load: lode"), TABLE,
     "NameError: name 'lode' is not defined"),
])  # fmt: skip
def test_wrong_input_is_named_with_its_place(tmp_path, code, table, words):
    told = " ".join(problems(tmp_path, code, table))
    assert words in told


def test_parameters_may_be_a_pydantic_model(tmp_path):
    code = POINT.replace(
        'def build(load: float = 3.0, limit: Annotated[float, "N"] = 0.5, points: int = 1):',
        "from pydantic import BaseModel\nclass P(BaseModel):\n    load: float = 3.0\n\n"
        "def build(p: P):\n    load, limit, points = p.load, 0.5, 1",
    )
    (told,) = problems(tmp_path, code, TABLE + "[model.parameters]\nlaod = 2.0\n")
    assert "Did you mean 'load'?" in told
    config = read_config(
        written(tmp_path, code, TABLE + "[model.parameters]\nload = 2.0\n"), allow_code=True
    )
    assert config.tree()["model"]["parameters"] == {"load": 2.0}


def test_parameters_may_be_keywords_choices_and_lists(tmp_path):
    code = POINT.replace(
        'def build(load: float = 3.0, limit: Annotated[float, "N"] = 0.5, points: int = 1):',
        "import enum\nclass Kind(enum.Enum):\n    small = 'small'\n    large = 'large'\n\n"
        "def build(*, kind: Kind = Kind.small, limits: tuple[float, float] = (0.0, 0.5),\n"
        '          load: Annotated[float, "N"] = "3000 mN"):\n    limit, points = limits[1], 1\n'
        "    assert kind is Kind.large and load == 3.0",
    )
    table = TABLE + '[model.parameters]\nkind = "large"\nlimits = [0.0, 0.25]\n'
    config = read_config(written(tmp_path, code, table), allow_code=True)
    found = config.tree()["model"]["parameters"]
    assert found == {"kind": "large", "limits": [0.0, 0.25], "load": 3.0}


def test_check_names_the_method_and_the_reason(tmp_path):
    result = CliRunner().invoke(app, ["check", str(written(tmp_path)), "--allow-code"])
    assert result.exit_code == 0
    assert "ExpRosenbrock" in result.stdout and "affine" in result.stdout


def test_check_names_the_line_of_an_error_in_a_function_of_the_problem(tmp_path):
    file = written(tmp_path, POINT.replace("1.0 - 2.0 * x - u", "damping * x"))
    for command in (["check", str(file)], ["run", str(file), "-o", str(tmp_path / "out")]):
        result = CliRunner().invoke(app, [*command, "--allow-code"])
        assert result.exit_code == 2
        assert "own.py, line" in result.stderr and "name 'damping' is not defined" in result.stderr


@pytest.mark.slow
def test_new_writes_a_problem_that_runs_and_whose_test_passes(tmp_path):
    folder = tmp_path / "mine"
    assert CliRunner().invoke(app, ["new", str(folder)]).exit_code == 0
    again = CliRunner().invoke(app, ["new", str(folder)])
    assert again.exit_code == 2 and "no file is written over another one" in again.stderr
    found = run(read_config(folder / "spring.toml", allow_code=True), folder / "run")
    assert found.exit_code == 0 and found.summary["largest_force"]["value"] == 5.0
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(folder)],
        capture_output=True, text=True, cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout


def test_end_of_a_run_may_have_a_unit_of_time(tmp_path):
    file = written(tmp_path, POINT, TABLE + 't_end = "90 s"\n')
    config = read_config(file, allow_code=True)
    assert config.model.t_end == 1.5 and config.tree()["model"]["t_end"] == "90 s"


@pytest.mark.parametrize(
    ("body", "value"), [("x0 = 1.0 / load", "0"), ("limit = -limit", "3.0"), ("load.shape", "2.5")]
)
def test_an_error_in_the_file_names_the_parameters_that_are_given(tmp_path, body, value):
    code = POINT.replace("points: int = 1):", f"points: int = 1):\n    {body}", 1)
    name = "limit" if "limit" in body else "load"
    table = f"{TABLE}\n[model.parameters]\n{name} = {value}\n"
    (problem, *_) = problems(tmp_path, code, table)
    assert f"[model.parameters] has {name} = {value}" in problem
