"""The contact law of the page: its numbers are those of `dvax run`, its derivative is one."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.app.cli.contact import write_config
from tests.app.explore.wave import write

from dvax.app.explore.contact import ContactSubject, load_default
from dvax.app.explore.separable import separated
from dvax.app.explore.subject import Question
from dvax.app.plots.run_reader import read_run
from dvax.app.runs import driver
from dvax.app.runs.config import build_contact, load_config
from dvax.app.runs.fields import to_signal

MOVED = {"model.b_x": 1.1, "model.kappa0": 1.2, "load.value": 1.8}


def values_of(subject: ContactSubject, **changes: float) -> dict[str, float]:
    return {p.key: p.value for p in subject.parameters} | changes


def nothing() -> None:
    pass


@pytest.fixture(scope="module")
def wave(tmp_path_factory: pytest.TempPathFactory) -> ContactSubject:
    return ContactSubject(load_config(write(tmp_path_factory.mktemp("wave"))))


@pytest.fixture(scope="module")
def values_elsewhere(wave: ContactSubject) -> dict[str, float]:
    return values_of(wave, **MOVED)


@pytest.fixture(scope="module")
def run_of_export(
    wave: ContactSubject,
    values_elsewhere: dict[str, float],
    tmp_path_factory: pytest.TempPathFactory,
) -> Any:
    """The run directory of the exported configuration."""
    folder = tmp_path_factory.mktemp("exported")
    name, text = wave.export("configuration", values_elsewhere)
    (folder / name).write_text(text, encoding="utf-8")
    outcome = driver.run(load_config(folder / name), folder / "run")
    assert outcome.status == "finished"
    return read_run(folder / "run")


@pytest.mark.slow
def test_contact_pressure_is_that_of_a_run_of_the_exported_configuration(
    wave: ContactSubject, values_elsewhere: dict[str, float], run_of_export: Any
) -> None:
    pressure = wave._solve(values_elsewhere).fields.pressure
    stored = run_of_export["pressure"].values
    assert stored.max() == pytest.approx(1.2), "the capacity is reached"
    np.testing.assert_allclose(pressure, stored, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_contact_figures_are_those_of_a_run(
    wave: ContactSubject, values_elsewhere: dict[str, float], run_of_export: Any
) -> None:
    answer = wave.solve(Question(values_elsewhere, values_elsewhere), nothing)
    shown = {n.name.replace(" ", "_"): n for n in answer.numbers}
    assert {"peak_pressure", "final_force", "sharp_decay_rate"} <= set(shown)
    for name, number in shown.items():
        expected = run_of_export.summary[name]
        assert float(number.text) == pytest.approx(expected["value"], rel=1e-8), name
        assert number.meaning == expected["meaning"]
    assert answer.certificate.status == "proved"


@pytest.mark.slow
def test_contact_derivative_is_the_limit_of_difference_quotients(
    wave: ContactSubject, values_elsewhere: dict[str, float]
) -> None:
    for key in ("model.b_x", "load.value"):
        exact = wave.derivative(values_elsewhere, key)
        step = 1e-5
        ends = [
            wave._solve(
                {**values_elsewhere, key: values_elsewhere[key] + sign * step}
            ).fields.pressure
            for sign in (1, -1)
        ]
        quotient = (ends[0] - ends[1]) / (2 * step)
        assert np.abs(exact).max() > 0.1
        # At a point that changes its regime, the quotient is a mean of both sides.
        assert np.mean(np.abs(quotient - exact) < 1e-6) > 0.95


@pytest.mark.slow
def test_contact_prediction_is_close_to_the_solution_after_a_small_move(
    wave: ContactSubject,
) -> None:
    base = values_of(wave)
    values = {**base, "model.alpha": 1.02}
    first = wave.solve(Question(values, base, "model.alpha"), nothing)
    assert first.has_more and not first.prediction
    answer = wave.solve(Question(values, base, "model.alpha", derivative=True), nothing)
    assert answer.prediction == "Dashed: α from 1 to 1.02 1/s, to first order."
    force = next(d for d in answer.drawings if d.key == "force")
    actual, predicted = (np.asarray(curve["y"], float) for curve in force.data)
    before = np.asarray(wave._solve(base).fields.pressure @ wave.inputs.boundary.weights)
    change = np.abs(actual - before).max()
    # The largest error is at the time at which a point changes its regime.
    assert np.abs(actual - predicted).max() < 0.2 * change
    assert np.median(np.abs(actual - predicted)) < 0.01 * change


@pytest.mark.thorough
def test_contact_code_gives_the_same_numbers(
    wave: ContactSubject,
    values_elsewhere: dict[str, float],
    run_of_export: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    name, text = wave.export("code", values_elsewhere)
    (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.setattr("sys.argv", [name, str(tmp_path / "run")])
    runpy.run_path(str(tmp_path / name))
    printed = dict(line.split()[:2] for line in capsys.readouterr().out.splitlines())
    for figure in ("peak_pressure", "final_force", "error_bound_x"):
        assert float(printed[figure]) == run_of_export.summary[figure]["value"], figure


@pytest.mark.thorough
def test_contact_map_has_the_certified_boundary_where_the_rate_is_zero(
    wave: ContactSubject,
) -> None:
    values = values_of(wave, **{"model.alpha": 0.1, "model.d_x": 0.1})
    drawing = wave.stability_map(values, "model.b_x", "model.d_u")
    observed, sharp, paper, point = drawing.data
    b_x, d_u = np.meshgrid(sharp["x"], sharp["y"])
    rate = 0.1 + 0.1 - d_u * b_x / 1.6
    np.testing.assert_allclose(sharp["z"], rate, atol=1e-5)
    np.testing.assert_allclose(paper["z"], rate - 0.2, atol=1e-5)
    # No trajectories approach more slowly than is certified.
    assert (observed["z"] > sharp["z"] - 1e-4).all()
    assert point["x"] == [values["model.b_x"]] and point["y"] == [values["model.d_u"]]


def test_contact_formula_in_factors_is_the_same_function(tmp_path: Path) -> None:
    inputs = build_contact(load_config(write(tmp_path)))
    for field in (inputs.demand, inputs.load):
        for t in (0.0, 0.3, 0.9):
            separate = separated(field, inputs.boundary)(t)
            whole = to_signal(field, inputs.boundary)(t)
            np.testing.assert_allclose(separate, np.broadcast_to(whole, separate.shape), rtol=1e-14)


@pytest.mark.thorough
def test_contact_with_measured_data_exports_a_configuration_and_code_that_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # Steps end at the saved times, as those of a run do.
    config = load_config(write_config(tmp_path, ("frames = 8", "frames = 10")))
    subject = ContactSubject(config)
    values = values_of(subject, **{"model.b_u": 0.7})
    answer = subject.solve(Question(values, values), nothing)
    name, text = subject.export("configuration", values)
    assert "load.csv" in text.splitlines()[1]
    (tmp_path / name).write_text(text, encoding="utf-8")
    outcome = driver.run(load_config(tmp_path / name), tmp_path / "run")
    force = next(n for n in answer.numbers if n.name == "final force")
    assert float(force.text) == pytest.approx(outcome.summary["final_force"]["value"], rel=1e-8)
    name, text = subject.export("code", values)
    (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.setattr("sys.argv", [name, str(tmp_path / "again")])
    runpy.run_path(str(tmp_path / name))
    lines = dict(line.split()[:2] for line in capsys.readouterr().out.splitlines())
    assert float(lines["final_force"]) == outcome.summary["final_force"]["value"]


@pytest.mark.thorough
def test_contact_on_a_surface_is_drawn_frame_by_frame(tmp_path: Path) -> None:
    file = write(tmp_path)
    text = file.read_text(encoding="utf-8")
    text = text.replace("length = 4.0\npoints = 12", "lengths = [4.0, 3.0]\npoints = [5, 4]")
    text = text.replace("pi*s/4", "pi*s1/4").replace("0.1*s)", "0.1*s1)")
    file.write_text(text, encoding="utf-8")
    subject = ContactSubject(load_config(file))
    values = values_of(subject)
    answer = subject.solve(Question(values, values, "model.b_x", True), nothing)
    assert [d.key for d in answer.drawings] == ["force", "certificate"]
    assert answer.frames is not None
    pressure, regime = answer.frames.draw(3)[0].data
    assert pressure["z"].shape == regime["z"].shape == (4, 5)


def test_contact_defaults_have_2000_points() -> None:
    config = load_default()
    assert config.boundary.points == [2000]
    # Steps end at the saved times, so that a run in blocks takes the same ones.
    assert config.solver.dt is not None
    steps = config.time.end / config.time.frames / config.solver.dt
    assert steps == pytest.approx(round(steps))
