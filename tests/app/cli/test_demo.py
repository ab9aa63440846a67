"""`dvax demo`: the demonstration strip, at full and at other resolutions."""

import json
import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from dvax._figure_text import entry_text
from dvax.app.cli.demo import CONFIG
from dvax.app.cli.program import app
from dvax.app.cli.resample import resample
from dvax.app.runs.config import build_contact, load_config

DEMO = Path(str(files("dvax.app.runs") / "demo"))


@pytest.mark.slow
def test_demo_runs_at_few_points_and_is_self_contained(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    result = CliRunner().invoke(app, ["demo", "-o", str(out), "--points", "50"])
    assert result.exit_code == 0, result.output
    assert json.loads((out / "manifest.json").read_text())["status"] == "finished"
    assert (out / "report.html").is_file()
    # Its sampled input was in a folder that is gone; the run keeps copies of what it read.
    again = load_config(out / "config.resolved.toml")
    assert again.boundary.points == [50]
    assert build_contact(again).boundary.size == 50


@pytest.mark.thorough
def test_demo_report_has_at_most_three_megabytes_and_begins_with_its_proof(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    result = CliRunner().invoke(app, ["demo", "-o", str(out), "-q"])
    assert result.exit_code == 0, result.output
    page = out / "report.html"
    assert page.stat().st_size <= 3e6
    entry = json.loads((out / "summary.json").read_text())["error_bound_sharp_x"]
    share = entry_text({"value": entry["relative"], "bound": "proved"}).removeprefix("≤ ")
    text = page.read_text(encoding="utf-8")
    assert 'The error bound is <span class="status proved">proved</span>' in text
    assert f"at most {share} of the norm of the solution" in re.sub("<[^>]*>", "", text)


def test_demo_does_not_overwrite_other_files(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    for force in ([], ["--force"]):
        result = CliRunner().invoke(app, ["demo", "-o", str(tmp_path), "--points", "50", *force])
        assert result.exit_code == 2
        assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]


def test_demo_without_points_is_wrong_usage(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["demo", "-o", str(tmp_path / "out"), "--points", "0"])
    assert result.exit_code == 2
    assert not (tmp_path / "out").exists()


def test_demo_resampling_at_the_same_points_is_the_identity(tmp_path: Path) -> None:
    shipped = load_config(DEMO / CONFIG)
    count = shipped.boundary.points
    assert count is not None
    same = load_config(resample(DEMO / CONFIG, tmp_path, count[0]))
    assert same.model_dump() == shipped.model_dump()
    before, after = build_contact(shipped), build_contact(same)
    assert before.demand.profile is not None and after.demand.profile is not None
    np.testing.assert_allclose(
        after.demand.profile.values, before.demand.profile.values, rtol=0, atol=1e-12
    )


def test_demo_coarse_strip_lies_within_the_fine_one(tmp_path: Path) -> None:
    fine = build_contact(load_config(DEMO / CONFIG)).demand.profile
    coarse = build_contact(load_config(resample(DEMO / CONFIG, tmp_path, 4000))).demand.profile
    assert fine is not None and coarse is not None
    assert coarse.values.shape == (4000,)
    # The midpoints of 4000 cells are midpoints of every fifth of 20 000: the same heights.
    np.testing.assert_allclose(coarse.values, fine.values[2::5], atol=1e-12)
