"""A configuration of a model on the page: sliders, numbers, derivative, exports."""

import runpy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.app.sweeps.decay import CONFIG, MODEL, depth

from dvax.app.explore.model import ModelSubject
from dvax.app.explore.open_subject import open_subject
from dvax.app.explore.subject import Outdated, Parameter, Question
from dvax.app.runs import driver
from dvax.app.runs.applications.config import read_config
from dvax.errors import InputError

TANK = "C1 1 0 1u IC=10\nL1 1 0 10m\nD1 1 0 R=1k\n"


def nothing() -> None:
    pass


def values_of(subject: ModelSubject, **changes: float) -> dict[str, float]:
    return {p.key: p.value for p in subject.parameters} | changes


@pytest.fixture
def decay(tmp_path: Path) -> ModelSubject:
    (tmp_path / "decay.py").write_text(MODEL)
    (tmp_path / "decay.toml").write_text(CONFIG)
    subject = open_subject(tmp_path / "decay.toml", allow_code=True)
    assert isinstance(subject, ModelSubject)
    return subject


def test_model_sliders_have_names_units_and_ranges(decay: ModelSubject) -> None:
    found = {p.key: p for p in decay.parameters}
    assert found["model.parameters.rate"] == Parameter(
        "model.parameters.rate", "rate", "1/s", 0.1, 10.0, 1.0, log=True
    )
    push = found["model.parameters.push"]
    assert (push.unit, push.low, push.high, push.log) == ("mm/s", -1.0, 1.0, False)


@pytest.mark.slow
def test_model_solution_and_prediction_have_their_closed_forms(decay: ModelSubject) -> None:
    rate, push = "model.parameters.rate", "model.parameters.push"
    base = values_of(decay, **{push: 0.5})
    values = {**base, rate: 1.2}
    answer = decay.solve(Question(values, base, rate, derivative=True), nothing)
    assert answer.certificate.status != "not known"
    figure = next(n for n in answer.numbers if n.name == "final depth")
    assert float(figure.text) == pytest.approx(depth(1.0, 1.2, 0.5), abs=1e-6)
    histories = answer.drawings[0]
    predicted = next(curve for curve in histories.data if curve.get("name") == "predicted")
    assert predicted["y"] != histories.data[0]["y"]
    slope = decay._slope(base, rate, nothing, wanted=True)
    assert slope is not None
    t = np.linspace(0.0, 1.0, 5)
    h = 1e-6
    exact = (depth(t, 1.0 + h, 0.5) - depth(t, 1.0 - h, 0.5)) / (2 * h)
    np.testing.assert_allclose(slope["depth"], exact, atol=1e-3)


@pytest.mark.thorough
def test_model_numbers_are_those_of_a_run_of_its_exports(
    decay: ModelSubject,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    values = values_of(decay, **{"model.parameters.rate": 1.7})
    answer = decay.solve(Question(values, values), nothing)
    shown = float(next(n for n in answer.numbers if n.name == "final depth").text)
    name, text = decay.export("configuration", values)
    assert "growth" not in text, "a value that was not moved stays as it was written"
    (tmp_path / name).write_text(text, encoding="utf-8")
    outcome = driver.run(read_config(tmp_path / name, allow_code=True), tmp_path / "run")
    assert outcome.summary["final_depth"]["value"] == pytest.approx(shown, rel=1e-9)
    name, text = decay.export("code", values)
    (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.setattr("sys.argv", [name, str(tmp_path / "again")])
    runpy.run_path(str(tmp_path / name))
    printed = dict(line.split()[:2] for line in capsys.readouterr().out.splitlines())
    assert float(printed["final_depth"]) == outcome.summary["final_depth"]["value"]


def test_model_ends_a_solve_that_is_outdated(decay: ModelSubject) -> None:
    def outdated() -> None:
        raise Outdated

    values = values_of(decay, **{"model.parameters.rate": 1.4})
    with pytest.raises(Outdated):
        decay.solve(Question(values, values), outdated)


def test_model_reports_a_value_that_it_refuses(decay: ModelSubject) -> None:
    values = values_of(decay, **{"model.parameters.rate": 13.0})
    with pytest.raises(InputError, match="this rate has no model"):
        decay.solve(Question(values, values), nothing)


def test_own_model_needs_the_flag_for_code(tmp_path: Path) -> None:
    (tmp_path / "decay.py").write_text(MODEL)
    (tmp_path / "decay.toml").write_text(CONFIG)
    with pytest.raises(InputError, match="--allow-code"):
        open_subject(tmp_path / "decay.toml")


@pytest.mark.thorough
def test_circuit_has_sliders_within_the_limits_of_its_schema(tmp_path: Path) -> None:
    (tmp_path / "a.cir").write_text(TANK)
    file = tmp_path / "tank.toml"
    file.write_text('[model]\nname = "circuit"\nnetlist = "a.cir"\nt_end = "5 ms"\nr_on = 0.1\n')
    subject = open_subject(file)
    assert isinstance(subject, ModelSubject)
    assert {p.key: p.unit for p in subject.parameters} == {"model.t_end": "s", "model.r_on": "ohm"}
    assert all(p.low > 0 for p in subject.parameters)
    values = values_of(subject)
    check: Callable[[], None] = nothing
    answer = subject.solve(Question(values, values, "model.t_end", True), check)
    outcome = driver.run(read_config(file), tmp_path / "run")
    final = outcome.summary["error_bound"]["value"]
    assert final is not None and answer.numbers
