"""A bound on the error of the state that certifies no digit: what is said, and the key `energy`."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import dvax
from dvax._figure_text import entry_text
from dvax.app.cli.program import app
from dvax.app.runs.applications.certificate import Certificate
from dvax.app.runs.applications.config import read_config
from dvax.app.runs.applications.models.python import _bound_unit
from dvax.app.runs.state_bound import useless_bound

CODE = """
import jax.numpy as jnp
import dvax

def build(bend: float = 0.0, declared: bool = False):
    problem = dvax.Problem(
        A=dvax.generators.Dense(jnp.array([[0.0, 1.0], [-40.0, -2.0]])),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-5.0, 5.0),
        f=lambda t, x, u, args: jnp.stack([bend * jnp.sin(x[1]), u]),
        h=lambda t, x, u, args: -8.0 * x[1], control_space=dvax.spaces.Euclidean(()),
    )
    constants = dvax.verify(problem, jnp.zeros(2)).constants if declared else None
    return dvax.models.Model(problem, jnp.array([1.0, 0.0]), 3.0, constants=constants)
"""
TABLE = (
    '[model]\npython = "spring.py:build"\nframes = 2\n[output]\nreport = false\n'
    "[model.parameters]\nbend = 0.0\n"
)
BY_CONSTANTS = TABLE.replace("frames = 2", "frames = 2\nbound_steps = 0")
WITH_ENERGY = TABLE.replace("frames = 2", "frames = 2\nenergy = true")


def written(folder, table=TABLE):
    folder.mkdir()
    (folder / "spring.py").write_text(CODE)
    (folder / "spring.toml").write_text(table)
    return folder / "spring.toml"


def call(*words):
    result = CliRunner().invoke(app, [*map(str, words), "--allow-code"])
    assert result.exit_code == 0, result.stderr
    return result.stderr


def bound(directory):
    return json.loads((directory / "summary.json").read_text())["error_bound"]


@pytest.mark.slow
def test_check_and_run_say_that_a_bound_certifies_no_digit_and_energy_makes_it_small(tmp_path):
    file = written(tmp_path / "plain", BY_CONSTANTS)
    told = call("check", file)
    assert "may certify no digit" in told and "Try energy = true" in told
    assert "bound_steps = 0 in [model] asks for a bound by constants" in told
    told = call("run", file, "-o", tmp_path / "run")
    assert "exceeds the norm of the solution, so that it certifies no digit" in told
    assert "energy = true" in told and "weights" in told and "troubleshooting.md" in told
    assert bound(tmp_path / "run")["relative"] > 1
    file = written(tmp_path / "energy", WITH_ENERGY)
    assert "certif" not in call("check", file)
    assert "certif" not in call("run", file, "-o", tmp_path / "small")
    assert bound(tmp_path / "small")["relative"] < 1e-3


@pytest.mark.slow
def test_the_bound_of_a_plain_run_is_proved_along_the_trajectory(tmp_path):
    file = written(tmp_path / "plain")
    assert "certif" not in call("check", file)
    assert "certif" not in call("run", file, "-o", tmp_path / "run")
    found = bound(tmp_path / "run")
    assert found["bound"] == "proved" and found["relative"] < 1e-6


@pytest.mark.slow
def test_a_bound_that_ends_says_why_and_what_to_try(tmp_path):
    file = written(tmp_path / "short", TABLE.replace("frames = 2", "frames = 2\nbound_steps = 50"))
    told = call("run", file, "-o", tmp_path / "run")
    assert (
        "not finite" in told and "steps and did not reach" in told and "larger bound_steps" in told
    )
    found = bound(tmp_path / "run")
    assert not np.isfinite(float(found["value"])) and "steps and did not reach" in found["why"]


@pytest.mark.parametrize(("states", "space", "unit"), [
    ({"a": "m", "b": "m"}, {}, "m"),
    ({"a": "m", "b": "m/s"}, {}, ""),
    ({"a": "m", "b": "m"}, {"state_space": dvax.spaces.L2(np.array([2.0, 1.0]))}, ""),
])  # fmt: skip
def test_a_bound_has_the_unit_that_all_states_have_in_a_norm_without_weights(states, space, unit):
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: -x, **space,
    )  # fmt: skip
    assert _bound_unit(dvax.models.Model(problem, np.zeros(2), 1.0, states=states)) == unit


def test_check_says_that_no_norm_is_found(tmp_path):
    file = written(tmp_path / "bent", WITH_ENERGY.replace("bend = 0.0", "bend = 0.5"))
    assert "energy = true has found no norm" in call("check", file)


def test_energy_is_refused_where_nothing_is_searched(tmp_path, monkeypatch):
    file = written(tmp_path / "declared", WITH_ENERGY + "declared = true\n")
    with pytest.raises(dvax.InputError, match="model.energy.*the model declares its constants"):
        read_config(file, allow_code=True)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(dvax.InputError, match=r"model.energy.*pip install 'dvax\[energy\]'"):
        read_config(written(tmp_path / "missing", WITH_ENERGY), allow_code=True)


@pytest.mark.parametrize(("entry", "words"), [
    ({"value": 3.0, "bound": "proved", "relative": 1.5}, "certifies no digit"),
    ({"value": None, "bound": "proved"}, "not finite"),
    ({"value": "inf", "bound": "estimated"}, "not finite"),
    ({"value": "inf", "bound": "proved", "why": "of a kink"}, "about the error: of a kink."),
    ({"value": 3.0, "bound": "proved", "relative": 0.5}, None),
    ({"value": None, "bound": "not known"}, None),
])  # fmt: skip
def test_a_bound_is_useless_if_it_is_not_smaller_than_the_solution(entry, words):
    said = useless_bound({"error_bound": entry}, "Try this.")
    assert said is None if words is None else words in said and said.endswith("Try this.")


def test_bound_that_becomes_infinite_is_a_number_and_one_that_was_not_computed_is_not() -> None:
    infinite = Certificate(np.array([0.1, np.inf]), "estimated").figure("kg", "bound of x")
    assert entry_text({"value": infinite.value, "bound": infinite.bound}) == "∞"
    unknown = Certificate(np.full(2, np.nan), "not known").figure("kg", "bound of x")
    assert unknown.value is None
