"""Runs that go on from their checkpoints: the same results, bit for bit, whatever ended them before."""

import json
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray
from tests.app.runs.example import write
from tests.app.runs.test_own_problem import POINT, TABLE
from tests.app.runs.test_partial import SOLVE_ERROR, TANK, Stops
from tests.selection import mostly_thorough
from typer.testing import CliRunner

import dvax
from dvax.app.cli.program import app
from dvax.app.plots.run_reader import read_run
from dvax.app.runs import run as run_module
from dvax.app.runs.applications.config import read_config
from dvax.app.runs.checkpoints import Checkpoints
from dvax.app.runs.driver import resume, run
from dvax.app.runs.lock import lock
from dvax.app.runs.rundir import FrameStore

OUTPUT = "[output]\npng = false\nreport = false\ncheckpoint_seconds = 0\n"


def circuit(folder: Path) -> Path:
    (folder / "tank.cir").write_text(TANK)
    file = folder / "run.toml"
    file.write_text(
        '[model]\nname = "circuit"\nnetlist = "tank.cir"\nt_end = "1 ms"\nframes = 20\n' + OUTPUT
    )
    return file


def own(folder: Path) -> Path:
    (folder / "own.py").write_text(POINT)
    file = folder / "run.toml"
    file.write_text(TABLE + "[model.parameters]\npoints = 3\n" + OUTPUT)
    return file


def contact(folder: Path) -> Path:
    output = {"report": False, "png": False, "checkpoint_seconds": 0.0}
    return write(folder, {"time.frames": 12, "output": output})


MODELS = {"circuit": circuit, "own": own, "contact": contact}


def results(directory: Path) -> dict[str, bytes]:
    """The contents of the trajectory and the summary."""
    kept = {p for p in directory.rglob("*") if p.is_file() and "trajectory.zarr" in str(p)}
    kept.add(directory / "summary.json")
    return {str(p.relative_to(directory)): p.read_bytes() for p in kept}


def go_on(directory: Path, listener=None):
    config = read_config(directory / "config.resolved.toml", allow_code=True)
    return resume(config, directory, listener)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """For each model the configuration, the complete run, and one that was stopped."""
    found = {}
    for name, prepare in MODELS.items():
        folder = tmp_path_factory.mktemp(name)
        config = prepare(folder)
        read = lambda config=config: read_config(config, allow_code=True)  # noqa: E731
        whole = run(read(), folder / "whole")
        assert whole.exit_code == 0 and not (folder / "whole" / "checkpoints").exists()
        part = run(read(), folder / "part", on_event=Stops(4, KeyboardInterrupt()))
        assert part.exit_code == 130 and (folder / "part" / "checkpoints").is_dir()
        found[name] = folder
    return found


@pytest.fixture(params=mostly_thorough(MODELS, ["own"]))
def folder(request, made):
    return made[request.param]


@pytest.fixture
def part(folder, tmp_path):
    """A copy of the run that was stopped."""
    return Path(shutil.copytree(folder / "part", tmp_path / "part"))


def events(directory: Path, kind: str) -> list[dict]:
    lines = (directory / "log.jsonl").read_text(errors="replace").splitlines()
    return [event for line in lines if (event := intact(line)).get("event") == kind]


def intact(line: str) -> dict:
    """The event of a line of a log, {} where the line is damaged."""
    try:
        event = json.loads(line)
    except ValueError:
        return {}
    return event if isinstance(event, dict) else {}


@pytest.mark.slow
def test_a_resumed_run_equals_one_that_was_not_interrupted(folder, part):
    again = go_on(part, Stops(2, SOLVE_ERROR))
    assert again.exit_code == 3
    outcome = go_on(part)
    assert outcome.exit_code == 0 and results(part) == results(folder / "whole")
    told = [event["stage"] for event in events(part, "stage")]
    assert len([words for words in told if words.startswith("going on from t = ")]) == 2
    resumed = read_run(part).resumed
    assert 1 <= len(resumed) <= 2 and all(words.startswith("t = ") for words in resumed)
    assert not (part / "checkpoints").exists()
    manifest, whole = (
        json.loads((d / "manifest.json").read_text()) for d in (part, folder / "whole")
    )
    for key in ("status", "steps", "rejected_steps", "method", "constants", "title"):
        assert manifest.get(key) == whole.get(key)


@pytest.mark.slow
def test_a_run_that_another_process_finished_meanwhile_is_not_done_again(folder, tmp_path):
    whole = Path(shutil.copytree(folder / "whole", tmp_path / "whole"))
    before = results(whole)
    with pytest.raises(dvax.InputError, match="a finished run"):
        go_on(whole)
    assert results(whole) == before


@pytest.mark.thorough
def test_a_run_that_failed_within_a_piece_resumes_at_its_beginning(tmp_path):
    """f is NaN for 1.03 < t < 1.09, and 21 frames make pieces of 0.2."""
    hole = POINT.replace(
        "load - 0.5 * x - u",
        "load - 0.5 * x - u + jnp.where((t > 1.03) & (t < 1.09), jnp.nan, 0.0)",
    )
    (tmp_path / "own.py").write_text(hole)
    config = tmp_path / "run.toml"
    config.write_text(TABLE.replace("frames = 20", "frames = 400") + OUTPUT)
    first = run(read_config(config, allow_code=True), tmp_path / "out")
    assert first.exit_code == 3 and "NaN" in first.stop_reason
    before = results(tmp_path / "out")
    again = go_on(tmp_path / "out")
    assert (again.exit_code, again.stop_reason) == (3, first.stop_reason)
    assert results(tmp_path / "out") == before


@pytest.mark.slow
def test_results_stay_until_there_are_better_ones(made, tmp_path):
    part = Path(shutil.copytree(made["circuit"] / "part", tmp_path / "part"))
    before = {name: data for name, data in results(part).items() if name != "summary.json"}

    def stops(event):
        if event.get("stage", "").startswith("going on"):
            raise KeyboardInterrupt

    assert go_on(part, stops).exit_code == 130
    after = results(part)
    assert {name: after[name] for name in before} == before
    assert go_on(part).exit_code == 0
    assert results(part) == results(made["circuit"] / "whole")


@pytest.mark.slow
def test_checkpoints_stay_until_the_results_are_written(made, tmp_path, monkeypatch):
    part = Path(shutil.copytree(made["circuit"] / "part", tmp_path / "part"))

    def full(*given):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(FrameStore, "finish", full)
        with pytest.raises(OSError, match="No space"):
            go_on(part)
    assert (part / "checkpoints").is_dir()
    assert go_on(part).exit_code == 0
    assert results(part) == results(made["circuit"] / "whole")


def test_a_checkpoint_that_cannot_be_written_is_a_warning(tmp_path, monkeypatch):
    def full(*given):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Checkpoints, "save", full)
    outcome = run(read_config(circuit(tmp_path)), tmp_path / "out", on_event=Stops(3, SOLVE_ERROR))
    assert (outcome.exit_code, outcome.has_results) == (3, True)
    assert any(
        "No checkpoint could be written" in w["message"]
        for w in events(tmp_path / "out", "warning")
    )


def test_figures_that_fail_leave_the_variables_over_time(tmp_path):
    file = own(tmp_path)
    (tmp_path / "own.py").write_text(POINT.replace("jnp.max(sol.us)", "[][1]"))
    outcome = run(read_config(file, allow_code=True), tmp_path / "out")
    assert outcome.exit_code == 2 and outcome.has_results
    assert "own.py, line" in outcome.stop_reason
    assert "Its figures are missing" in outcome.stop_reason
    with xarray.open_zarr(tmp_path / "out" / "trajectory.zarr", consolidated=False) as data:
        assert {"depth", "force"} <= set(data) and data.sizes["time"] >= 2


def test_hashes_end_with_the_last_complete_block(tmp_path):
    point = ("point",)
    store = FrameStore(
        tmp_path / "a.zarr", 12, 4, {"s": (point, np.arange(3.0), {})},
        {"p": (("time", "point"), np.float64, {})}, {}, {},
    )  # fmt: skip
    for begin, count in ((0, 4), (4, 4), (8, 2)):
        times = np.arange(begin, begin + count, dtype=float)
        store.write(times, {"p": np.ones((count, 3)) * times[:, None]})
    assert set(store.files(8)) == {"s/c/0", *(f"{n}" for n in ("time/c/0", "time/c/1"))} | {
        "p/c/0/0", "p/c/1/0",
    }  # fmt: skip


def test_left_over_folders_do_not_stop_a_run(made, tmp_path):
    part = Path(shutil.copytree(made["contact"] / "part", tmp_path / "part"))
    (part / ".trajectory.zarr.old" / "a").mkdir(parents=True)
    (part / "checkpoints" / "step_000008 (copy)").mkdir()
    assert go_on(part).exit_code == 0
    assert results(part) == results(made["contact"] / "whole")
    empty = tmp_path / "empty"
    empty.mkdir()
    lock(empty).close()
    assert run(read_config(made["circuit"] / "run.toml"), empty).exit_code == 0


def files_of(directory: Path) -> list[str]:
    return sorted(str(p.relative_to(directory)) for p in directory.rglob("*") if p.is_file())


REFUSED = ("config.resolved.toml", "inputs")
"""Without these there is no run to go on with."""


@pytest.mark.thorough
@pytest.mark.parametrize("harm", mostly_thorough(["flip", "truncate"], ["flip"]))
def test_a_damaged_file_is_named_and_not_used(folder, part, tmp_path, harm):
    rng, whole = random.Random(3), results(folder / "whole")
    names = [n for n in files_of(part) if n != ".lock"]
    # Of the many files of frames and pieces some.
    many = [n for n in names if "zarr" in n or n.startswith("checkpoints")]
    chosen = [n for n in names if n not in many] + rng.sample(many, min(6, len(many)))
    for name in chosen:
        copy = Path(shutil.copytree(part, tmp_path / "copy"))
        content = bytearray((copy / name).read_bytes())
        if content and harm == "flip":
            content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        (copy / name).write_bytes(content if harm == "flip" else content[: len(content) // 2])
        try:
            outcome = go_on(copy)
        except dvax.InputError:
            assert name.startswith(REFUSED), name
        else:
            assert outcome.exit_code == 0, (name, outcome.stop_reason)
            found = results(copy)
            # A title in a damaged manifest is lost; no number is.
            if name != "manifest.json":
                assert found == whole, name
            assert found["summary.json"] == whole["summary.json"]
            used = [w["message"] for w in events(copy, "warning") if "is not used" in w["message"]]
            if name.startswith("checkpoints"):
                assert any(name in words for words in used), name
        shutil.rmtree(copy)


def test_changed_settings_data_and_versions_are_refused_by_name(made, tmp_path, monkeypatch):
    part = Path(shutil.copytree(made["circuit"] / "part", tmp_path / "part"))
    file = part / "config.resolved.toml"
    text = file.read_text()
    file.write_text(text.replace("t_end = 0.001", "t_end = 0.002"))
    with pytest.raises(
        dvax.InputError, match=r"model.t_end: got 0.002; the run was made with 0.001"
    ):
        go_on(part)
    file.write_text(text)
    data = next((part / "inputs").iterdir())
    data.write_text(data.read_text().replace("R=1k", "R=2k"))
    with pytest.raises(dvax.InputError, match="data of model.netlist"):
        go_on(part)
    data.write_text(TANK)
    known = run_module.provenance()
    monkeypatch.setattr(run_module, "provenance", lambda: known | {"dvax": "9.9"})
    with pytest.raises(dvax.InputError, match="dvax: got 9.9"):
        go_on(part)


def test_one_process_at_a_time_writes_a_run(made, tmp_path):
    part = Path(shutil.copytree(made["circuit"] / "part", tmp_path / "part"))
    held = lock(part)
    code = (
        f"from dvax.app.runs.lock import lock; from pathlib import Path; lock(Path({str(part)!r}))"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "another process writes into" in other.stderr
    held.close()
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.slow
def test_resume_says_what_there_is_nothing_to_do_about(made, tmp_path):
    result = CliRunner().invoke(app, ["resume", str(made["circuit"] / "whole")])
    assert result.exit_code == 0 and "nothing to go on with" in result.stderr
    for place in (tmp_path, tmp_path / "none"):
        result = CliRunner().invoke(app, ["resume", str(place)])
        assert result.exit_code == 2 and "a run that can go on has" in result.stderr
    part = Path(shutil.copytree(made["own"] / "part", tmp_path / "part"))
    assert CliRunner().invoke(app, ["resume", str(part)]).exit_code == 2
    result = CliRunner().invoke(app, ["resume", str(part), "--allow-code"])
    assert result.exit_code == 0 and results(part) == results(made["own"] / "whole")


def test_checkpoints_are_there_as_a_whole_or_not_at_all(tmp_path, monkeypatch):
    kept = Checkpoints(tmp_path, {"a": "1"}, 5.0)
    for number in range(3):
        kept.save(number, [np.arange(4.0), number], {"t": 0.5, "bound": np.inf})
    full = OSError(28, "No space left on device")

    def fails(*given):
        raise full

    monkeypatch.setattr("os.fsync", fails)
    with pytest.raises(OSError, match="No space"):
        kept.save(3, [np.zeros(4)], {})
    found, damaged = Checkpoints(tmp_path, {"a": "1"}, 5.0).load()
    assert [c.number for c in found] == [0, 1, 2] and not damaged
    assert found[1].arrays[0].tolist() == [0.0, 1.0, 2.0, 3.0] and found[1].about["bound"] == "inf"
    kept.keep(2)
    assert [c.number for c in kept.load()[0]] == [1, 2]
    with pytest.raises(dvax.InputError, match="a: got 2; the run was made with 1"):
        Checkpoints(tmp_path, {"a": "2"}, 5.0).load()


@pytest.mark.thorough
@pytest.mark.parametrize("name", MODELS)
def test_runs_survive_kills_at_random_instants(name, made, tmp_path):
    rng, config = random.Random(7), made[name] / "run.toml"
    whole, program = results(made[name] / "whole"), [Path(sys.executable).with_name("dvax")]
    start = time.monotonic()
    subprocess.run(
        [*program, "run", config, "-o", tmp_path / "time", "-q", "--allow-code"], check=True
    )
    spent = time.monotonic() - start
    out, kills = tmp_path / "out", 0
    while kills < 67:
        command = ["run", config, "-o", out] if not out.exists() else ["resume", out]
        running = subprocess.Popen([*map(str, [*program, *command]), "-q", "--allow-code"])
        try:
            code = running.wait(rng.uniform(0.5, 1.05) * spent)
            assert code == 0 and results(out) == whole
            shutil.rmtree(out)
        except subprocess.TimeoutExpired:
            running.send_signal(rng.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGTERM]))
            running.wait()
            kills += 1
            if out.exists() and not (out / "manifest.json").exists():
                shutil.rmtree(out)  # nothing was written yet
    if out.exists():
        assert subprocess.run([*program, "resume", out, "-q", "--allow-code"]).returncode == 0
        assert results(out) == whole
