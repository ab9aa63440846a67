"""A sweep on a worker: results, failures, records, the report, and what a second call runs."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray
from typer.testing import CliRunner

import dvax
from dvax.app.cli.program import app
from dvax.app.plots.report import build_report
from dvax.app.runs.export import export_run
from dvax.app.runs.sweeps import driver
from dvax.app.runs.sweeps.driver import run_sweep
from dvax.app.runs.sweeps.member import create_store, run_member
from dvax.app.runs.sweeps.records import read_record
from dvax.app.runs.sweeps.store import NAME
from dvax.app.runs.sweeps.sweep import read_sweep

from .decay import END, depth, written

# The first member fails in a solve, and another one in the function that builds it.
RATES = [1.0, 2.0, 13.0, 3.0, 0.5]
GROWTH = [4.0, 0.0, 0.0, 0.0, 0.0]
PUSH = ["0 mm/s", "1 mm/s", "1 mm/s", "0.002 m/s", "0 mm/s"]
SWEEP = f"""title = "decays"
[zip]
"model.parameters.rate" = {RATES}
"model.parameters.growth" = {GROWTH}
"model.parameters.push" = {json.dumps(PUSH)}
"""
FINISHED = [1, 3, 4]


def values(directory):
    """Every array of a store, but for its metadata."""
    with xarray.open_zarr(directory / NAME) as data:
        return {name: np.asarray(array) for name, array in data.variables.items()}


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    return read_sweep(written(tmp_path_factory.mktemp("decay"), SWEEP), allow_code=True)


@pytest.fixture(scope="module")
def events():
    return []


@pytest.fixture(scope="module")
def outcome(sweep, events, tmp_path_factory):
    out = tmp_path_factory.mktemp("sweep") / "out"
    # One worker, since each compiles the program; two run in the tests of kills.
    return run_sweep(sweep, out, workers=1, tell=events.append)


@pytest.fixture
def copy(outcome, tmp_path):
    return Path(shutil.copytree(outcome.directory, tmp_path / "copy"))


@pytest.mark.slow
def test_results_are_those_of_the_closed_form_at_each_member(outcome):
    with xarray.open_zarr(outcome.directory / NAME) as data:
        assert data.attrs["title"] == "decays" and data.sizes["member"] == len(RATES)
        assert data["model.parameters.push"].attrs["units"] == "mm/s"
        push = data["model.parameters.push"].values
        assert push.tolist() == [0.0, 1.0, 1.0, 2.0, 0.0]
        for k in FINISHED:
            exact = depth(data.time.values, RATES[k], push[k])
            np.testing.assert_allclose(data.depth.values[k], exact, rtol=1e-5)
            np.testing.assert_allclose(data.final_depth.values[k], exact[-1], rtol=1e-5)
            np.testing.assert_array_equal(data.time_of_member.values[k], np.linspace(0, END, 5))
        assert data.depth.attrs["units"] == "mm"
        assert np.isnan(data.depth.values[[0, 2]]).all()


@pytest.mark.slow
def test_failures_are_named_and_leave_the_others_alone(outcome, events):
    assert outcome.exit_code == 3 and outcome.counts == {"finished": 3, "failed": 2}
    with xarray.open_zarr(outcome.directory / NAME) as data:
        meanings = data.status.attrs["flag_meanings"].split()
        assert [meanings[s] for s in data.status.values] == [
            "failed", "finished", "failed", "finished", "finished",
        ]  # fmt: skip
    text = (outcome.directory / "members.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    assert [line["member"] for line in lines] == list(range(len(RATES)))
    assert (lines[0]["exit_code"], lines[2]["exit_code"]) == (3, 2)
    assert "this rate has no model" in lines[2]["reason"] and lines[2]["values"] == {
        "model.parameters.rate": 13.0, "model.parameters.growth": 0.0,
        "model.parameters.push": "1 mm/s",
    }  # fmt: skip
    assert all(len(line["hash"]) == 64 for line in lines)
    assert {line["dvax"] for line in lines if "dvax" in line} == {dvax.__version__}
    seen = {event["member"]: event["status"] for event in events if event["event"] == "member"}
    assert sorted(seen) == list(range(len(RATES))) and seen[0] == seen[2] == "failed"
    # The folders of failed runs are kept, to look at.
    kept = {folder.name for folder in (outcome.directory / "members").iterdir() if folder.is_dir()}
    assert kept == {"000000"}  # the other one failed before there was a run


@pytest.mark.thorough
def test_second_call_runs_nothing_but_the_failed_members(sweep, copy):
    before, events = values(copy), []
    again = run_sweep(sweep, copy, resume=True, workers=1, tell=events.append)
    assert again.counts == {"finished": 3, "failed": 2}
    assert {e["member"] for e in events if e["event"] == "member"} == {0, 2}
    after = values(copy)
    assert all(np.array_equal(before[n], after[n], equal_nan=True) for n in before if n != "status")


@pytest.mark.slow
def test_member_alone_has_the_bits_of_the_sweep(sweep, copy):
    before = values(copy)
    for k in FINISHED:
        (copy / "members" / f"{k:06d}.json").unlink()
        record = run_member(sweep, copy, k)
        assert record["status"] == "finished" and record["unfit"] == []
    after = values(copy)
    assert before.keys() == after.keys()
    for name in before:
        np.testing.assert_array_equal(before[name], after[name], err_msg=name)


@pytest.mark.thorough
def test_changed_configuration_is_run_again_and_an_unchanged_one_is_not(sweep, copy, tmp_path):
    moved = shutil.copytree(sweep.source.parent, tmp_path / "moved")
    same = read_sweep(moved / "sweep.toml", allow_code=True)
    assert [same.hash(k) for k in range(5)] == [sweep.hash(k) for k in range(5)]
    config = moved / "decay.toml"
    config.write_text(config.read_text().replace("frames = 4", "frames = 8"))
    changed = read_sweep(moved / "sweep.toml", allow_code=True)
    assert not {changed.hash(k) for k in range(5)} & {sweep.hash(k) for k in range(5)}
    # Nine saved times do not fit into a store for five: they are named, and the run is kept.
    record = run_member(changed, copy, 1)
    assert record["status"] == "finished" and {"depth", "time"} <= set(record["unfit"])
    assert (copy / "members" / "000001" / "trajectory.zarr").is_dir()
    code, before = moved / "decay.py", changed.hash(1)
    code.write_text(code.read_text() + "\n")
    assert read_sweep(moved / "sweep.toml", allow_code=True).hash(1) != before


def test_other_parameters_need_another_folder(copy, tmp_path):
    other = read_sweep(written(tmp_path / "other", SWEEP.replace("0.5]", "0.6]")), allow_code=True)
    with pytest.raises(dvax.InputError, match="Go on with the sweep file of the beginning"):
        run_sweep(other, copy, resume=True)


def test_targets_are_checked_before_anything_runs(sweep, outcome, tmp_path):
    with pytest.raises(dvax.InputError, match="--resume"):
        run_sweep(sweep, outcome.directory)
    (tmp_path / "file").write_text("")
    with pytest.raises(dvax.InputError, match="a file"):
        run_sweep(sweep, tmp_path / "file")
    with pytest.raises(dvax.InputError, match="no sweep"):
        run_sweep(sweep, tmp_path / "none", resume=True)
    assert driver.target_problems(tmp_path / "none", resume=False) == []


@pytest.mark.thorough
def test_report_shows_figures_failures_and_ranges(copy):
    page = build_report(copy).read_text()
    assert "2 members failed" in page and "this rate has no model" in page
    assert "Figures over rate" in page and "Parameters and figures" in page
    lead = page.split('<section class="lead"')[1].split("</section>")[0]
    assert "This sweep ran decay.toml for" in lead and "of them finished." in lead
    assert 'The error bound is <span class="status proved">proved</span> for 3 members' in lead
    drawn = {file.name for file in (copy / "figures").iterdir()}
    assert {"parallel.png", "response-model-parameters-rate.png"} <= drawn


def test_export_of_a_sweep_names_its_store(outcome, tmp_path):
    with pytest.raises(
        dvax.InputError, match=r"folder of a sweep.*one run.*open_zarr\(.*sweep\.zarr"
    ):
        export_run(outcome.directory, tmp_path / "a.csv")


@pytest.mark.slow
def test_damaged_record_is_run_again(sweep, copy):
    (copy / "members" / "000003.json").write_text("{")
    assert read_record(copy, 3) is None
    assert run_member(sweep, copy, 3)["status"] == "finished"


@pytest.mark.slow
def test_command_line_of_members(sweep, outcome, copy, tmp_path):
    file = str(sweep.source)

    def call(*words):
        return CliRunner().invoke(app, ["sweep", file, "--allow-code", *words])

    shown = call("--list")
    assert shown.exit_code == 0 and shown.stdout.count("\n") == 6
    assert call().exit_code == 2
    early = call("-o", str(tmp_path / "none"), "--member", "1")
    assert early.exit_code == 2 and "--create" in early.stderr
    assert call("-o", str(copy), "--member", "5").exit_code == 2
    failed = call("-o", str(copy), "--member", "0")
    assert failed.exit_code == 3 and "failed" in failed.stderr
    assert call("-o", str(copy), "--member", "1").exit_code == 0  # complete: nothing is run
    refused = CliRunner().invoke(app, ["sweep", file, "-o", str(tmp_path / "none")])
    assert refused.exit_code == 2 and "--allow-code" in refused.stderr
    wrong = CliRunner().invoke(app, ["run", file, "-o", str(tmp_path / "none")])
    assert wrong.exit_code == 2 and "dvax sweep" in wrong.stderr


def test_unknown_variable_is_named_with_the_known_ones(sweep, copy, tmp_path):
    shutil.rmtree(copy / NAME)
    (copy / "members" / "000001.json").unlink()
    assert run_member(sweep, copy, 1)["status"] == "solved"  # it waits for a store
    text = SWEEP + '[output]\nvariables = ["dept"]\n'
    other = read_sweep(written(tmp_path / "other", text), allow_code=True)
    with pytest.raises(dvax.InputError, match="'dept'.*depth, error_bound, force, time"):
        create_store(other, copy, 1)
    create_store(sweep, copy, 1)
    assert run_member(sweep, copy, 1)["status"] == "finished"
    assert np.isfinite(values(copy)["depth"][1]).all()
