"""Runs of applications that stop early: the computed part is kept, readable, and unchanged."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from tests.selection import mostly_thorough

import dvax
from dvax.app.plots import build_report
from dvax.app.runs.applications.base import Plan
from dvax.app.runs.applications.certificate import certificate
from dvax.app.runs.applications.config import read_config
from dvax.app.runs.applications.models.circuit import CircuitApplication
from dvax.app.runs.applications.segments import join_pieces, segments
from dvax.app.runs.driver import run
from dvax.app.runs.interrupt import Terminated, interruptible
from dvax.errors import Fix

TANK = "* a tank\nC1 1 0 1u IC=10\nL1 1 0 10m\nD1 1 0 R=1k\n"
TOML = '[model]\nname = "circuit"\nnetlist = "tank.cir"\nt_end = "1 ms"\nframes = 20\n'


def configured(folder: Path, more: str = ""):
    (folder / "tank.cir").write_text(TANK)
    (folder / "tank.toml").write_text(TOML + more + "[output]\npng = false\n")
    return read_config(folder / "tank.toml")


def frames_of(directory: Path) -> xarray.Dataset:
    with xarray.open_zarr(directory / "trajectory.zarr", consolidated=False) as data:
        return data.load()


class Stops:
    """A listener that raises at the `count`-th report of progress."""

    def __init__(self, count: int, error: BaseException):
        self.left, self.error = count, error

    def __call__(self, event) -> None:
        if event["event"] == "progress":
            self.left -= 1
            if self.left == 0:
                raise self.error


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The complete run."""
    folder = tmp_path_factory.mktemp("whole")
    return run(configured(folder), folder / "out")


SOLVE_ERROR = dvax.SolveError(
    "f is nan at t = 3.", None, (Fix("rtol", "1e-6", "why"), Fix("dt0", "1.0", "why not"))
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "status", "code"),
    [
        (KeyboardInterrupt(), "interrupted", 130),
        (Terminated(), "interrupted", 143),
        (SOLVE_ERROR, "failed", 3),
    ],
)
def test_stopped_run_keeps_its_frames_and_has_a_report(whole, tmp_path, error, status, code):
    config = configured(tmp_path)
    outcome = run(config, tmp_path / "part", on_event=Stops(3, error))
    assert (outcome.exit_code, outcome.status, outcome.has_results) == (code, status, True)
    everything, part = frames_of(whole.directory), frames_of(outcome.directory)
    assert 2 <= part.sizes["time"] < everything.sizes["time"] == 21
    for name in part:
        kept = everything[name].isel(time=slice(part.sizes["time"]))
        np.testing.assert_array_equal(part[name], kept, err_msg=str(name))
    summary = json.loads((outcome.directory / "summary.json").read_text())
    assert summary["status"]["value"] == status
    for name in ("C1", "L1"):
        assert summary[f"final_{name}"]["value"] == part[f"state_{name}"][-1]
    manifest = json.loads((outcome.directory / "manifest.json").read_text())
    assert manifest["status"] == status and manifest["steps"] > 0
    page = build_report(outcome.directory, stills=False).read_text(encoding="utf-8")
    assert "Partial results." in page and "The circuit over time" in page
    reason = summary["status"]["meaning"]
    assert reason in page.replace("&quot;", '"')
    if status == "failed":
        # Keys of the file, and none that it does not have.
        assert "Write model.rtol = 1e-6, why." in reason and "dt0" not in reason
    else:
        assert f"at t = {float(part.time[-1]):.10g} of 0.001 s" in reason


@pytest.mark.thorough  # a program of its own for every max_steps
def test_failed_run_keeps_its_frames_and_names_the_key(tmp_path):
    outcome = run(configured(tmp_path, "max_steps = 1\n"), tmp_path / "out")
    assert outcome.exit_code == 3 and "Write model.max_steps = " in outcome.stop_reason
    enough = int(outcome.stop_reason.split("model.max_steps = ")[1].split(",")[0])
    assert run(configured(tmp_path, f"max_steps = {enough}\n"), tmp_path / "again").exit_code == 0


def plan_of_the_closed_form(count: int, **settings) -> Plan:
    """The contact law of the paper at a point: x(2) has a closed form."""
    model = dvax.models.Contact(
        alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0, kappa0=0.5, g=1.0, ell=3.0
    )
    times = np.linspace(0.0, 2.0, count)
    return Plan(model.problem, jnp.asarray(-1.0), times, model.constants, settings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "settings"),
    mostly_thorough(
        [
            (count, settings)
            for count in (2, 3, 40, 41, 400)
            for settings in ({}, {"dt": 0.01}, {"method": dvax.DormandPrince()}, {"rtol": 1e-9})
        ],
        [(41, {})],
    ),
)
def test_segments_join_to_a_solution_whose_bound_holds(count, settings):
    plan = plan_of_the_closed_form(count, **settings)
    pieces = list(segments(plan))
    found = join_pieces(pieces)
    np.testing.assert_array_equal(found.ts, plan.times)
    assert found.defect is not None and found.completed_defect is not None
    assert np.all(np.diff(found.defect) >= 0) and np.all(found.defect >= found.completed_defect[0])
    bound = certificate(plan.problem, found, plan.constants)
    error = abs(float(found.xs[-1]) - 1.8360919559905713)
    assert error <= bound.values[-1] < 0.05
    at_once = dvax.solve(
        plan.problem,
        -1.0,
        0.0,
        2.0,
        ts=plan.times,
        constants=plan.constants,
        measure=True,
        **settings,
    )
    other = certificate(plan.problem, at_once, plan.constants)
    assert np.all(np.abs(found.xs - at_once.xs) <= bound.values + other.values)
    assert bound.status == other.status


def test_stopped_run_without_time_keeps_all_but_its_figures(tmp_path, whole, monkeypatch):
    config = configured(tmp_path)

    def hurried(*given):
        raise KeyboardInterrupt  # a second signal

    outcome = run(
        config, tmp_path / "part",
        on_event=lambda event: event["event"] == "compiled"
        and monkeypatch.setattr(CircuitApplication, "results", hurried),
    )  # fmt: skip
    assert outcome.exit_code == 130 and "Its figures are missing" in outcome.stop_reason
    part, everything = frames_of(outcome.directory), frames_of(whole.directory)
    assert part.identical(everything)
    page = build_report(outcome.directory, stills=False).read_text(encoding="utf-8")
    assert "Partial results." in page and "The circuit over time" in page


def test_work_in_a_thread_returns_and_raises_like_a_call():
    assert interruptible(lambda: 7) == 7
    with pytest.raises(dvax.InputError, match="x0"):
        interruptible(lambda: dvax.verify(plan_of_the_closed_form(2).problem, float("nan")))


FOREVER = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
import jax
from dvax.app.runs.applications.models.circuit import CircuitApplication

def endless(self, *given):
    print("endless", file=sys.stderr, flush=True)
    loop = jax.jit(lambda x: jax.lax.while_loop(lambda v: v < 2.0, lambda v: 1.5 - v, x))
    return loop(1.0).block_until_ready()

setattr(CircuitApplication, sys.argv.pop(1), endless)
from dvax.app.cli import main
main()
"""


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("stage", "command", "number"),
    mostly_thorough(
        [
            (stage, command, number)
            for number in (signal.SIGINT, signal.SIGTERM)
            for stage, command in (
                ("plan", "run"),
                ("results", "run"),
                ("__init__", "run"),
                ("__init__", "check"),
            )
        ],
        [("plan", "run", signal.SIGTERM)],
    ),
)
def test_signal_ends_an_endless_compiled_loop(tmp_path, stage, command, number):
    configured(tmp_path)
    out = tmp_path / "out"
    words = [command, str(tmp_path / "tank.toml"), *(["-o", str(out)] if command == "run" else [])]
    process = subprocess.Popen(
        [sys.executable, "-c", FOREVER, stage, *words], stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(Path(dvax.__file__).parents[1])},
    )  # fmt: skip
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith("endless"):
            break
    process.send_signal(number)
    _, text = process.communicate(timeout=100)  # without the signal it would never end
    assert process.returncode == (130 if number == signal.SIGINT else 143), text
    assert "Traceback" not in text
    if command == "run" and stage != "__init__":
        manifest = json.loads((out / "manifest.json").read_text())
        assert manifest["status"] == "interrupted"
