"""A new ready model is one file: the exercise of docs/layout.md."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray

MODEL = '''
"""`[model] name = "decay"`: x' = −ax + u, where a law holds x above its least value."""

from typing import Literal

from pydantic import Field

import dvax
from dvax.app.runs.applications.from_model import AbstractModelApplication, FramesKeys
from dvax.models import Model


class DecaySection(FramesKeys):
    name: Literal["decay"] = Field(description="the model")
    rate: float = Field(1.0, gt=0, description="rate of decay [1/s]")


class DecayApplication(AbstractModelApplication):
    section = DecaySection

    def __init__(self, table, paths, quiet):
        self.table = table
        problem = dvax.Problem(
            A=dvax.generators.Scalar(-table.rate), P=dvax.operators.Scaling(1.0),
            K=dvax.sets.Box(0.0, 0.5), f=lambda t, x, u, args: u, h=lambda t, x, u, args: -x - u,
        )
        names = {"states": {"depth": "mm"}, "responses": {"force": "N"}}
        self.set_model(Model(problem, 1.0, 2.0, **names))

    @property
    def fit(self):
        return "exact"

    def series(self, solution, bound):
        return {**self.named(solution), **self.bound_series(bound)}

    def figures(self, series, end, bound):
        return {**self.final_values(end), **self.bound_figure(bound)}


APPLICATION = DecayApplication
'''
# As if the file lay in the folder of the ready models.
DVAX = (
    "import sys; from dvax.app.runs.applications import models\n"
    "models.__path__.append(sys.argv.pop(1)); from dvax.app.cli import main; main()"
)


def dvax(folder: Path, *words: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", DVAX, str(folder / "models"), *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.mark.thorough
def test_new_ready_model_is_one_file(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "decay.py").write_text(MODEL, encoding="utf-8")
    config = tmp_path / "a.toml"
    config.write_text('[model]\nname = "decay"\nrates = 3.0\n')
    refused = dvax(tmp_path, "check", "a.toml")
    assert refused.returncode == 2 and "Did you mean 'rate'?" in refused.stderr
    config.write_text('[model]\nname = "decay"\nrate = 3.0\nframes = 10\n[output]\npng = false\n')
    done = dvax(tmp_path, "run", "a.toml", "-o", "out")
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    apart = abs(summary["final_depth"]["value"] - np.exp(-6.0))
    assert apart <= summary["error_bound"]["value"] < 1e-6
    with xarray.open_zarr(tmp_path / "out" / "trajectory.zarr") as data:
        assert list(data["depth"].dims) == ["time"] and data["depth"].attrs["units"] == "mm"
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "model decay, exact" in page and "States and responses over time" in page
