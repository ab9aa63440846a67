"""A saved run on the page."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from tests.app.plots.synthetic import Recipe, write_run

from dvax.app.explore.open_subject import open_subject
from dvax.app.explore.saved import SavedRun
from dvax.app.explore.subject import Question
from dvax.errors import InputError

EMPTY = Question({}, {})


@pytest.fixture
def run(tmp_path: Path) -> SavedRun:
    subject = open_subject(write_run(tmp_path / "run", Recipe((30,), frames=5)))
    assert isinstance(subject, SavedRun)
    return subject


def test_saved_run_shows_the_fields_at_each_saved_time(run: SavedRun) -> None:
    answer = run.solve(EMPTY, lambda: None)
    assert {"pressure", "regimes", "shares"} <= {d.key for d in answer.drawings}
    assert answer.frames is not None
    for frame in range(len(answer.frames.times)):
        drawn = {d.key: d for d in answer.frames.draw(frame)}
        stored = run.run["pressure"].values[frame]
        np.testing.assert_allclose(drawn["frame-pressure"].data[0]["y"], stored, rtol=1e-6)


def test_saved_run_on_a_surface_is_shown_as_a_map(tmp_path: Path) -> None:
    subject = open_subject(write_run(tmp_path / "run", Recipe((30, 20), frames=5)))
    answer = subject.solve(EMPTY, lambda: None)
    assert answer.frames is not None
    drawn = {d.key: d for d in answer.frames.draw(2)}
    assert drawn["frame-pressure"].data[0]["z"].shape == (20, 30)


def test_saved_run_without_results_is_described(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", Recipe((30,), frames=5))
    for file in sorted((folder / "trajectory.zarr").rglob("*"), reverse=True):
        file.rmdir() if file.is_dir() else file.unlink()
    (folder / "trajectory.zarr").rmdir()
    answer = open_subject(folder).solve(EMPTY, lambda: None)
    assert answer.drawings == [] and answer.frames is None


def test_saved_run_exports_code_that_reads_it(
    run: SavedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, text = run.export("code", {})
    (tmp_path / name).write_text(text, encoding="utf-8")
    runpy.run_path(str(tmp_path / name))
    assert "pressure" in capsys.readouterr().out


def test_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"manifest\.json"):
        open_subject(tmp_path)
