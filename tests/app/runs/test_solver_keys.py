"""Every model's table takes the options of the solver, and a failure names them as keys of the file."""

import inspect
from pathlib import Path
from typing import Any

import pytest

import dvax
from dvax.app.runs.applications.config import APPLICATIONS, module_of, read_config, wording_of
from dvax.app.runs.schema import SolverKeys, SolverSection
from dvax.app.runs.solver_options import event_driven, settings
from dvax.errors import Fix

OPTIONS = {"method", "rtol", "atol", "dt", "dt_max", "max_steps", "vi_solver"}
GIVEN: list[dict[str, Any]] = [
    {"rtol": 1e-5, "atol": 1e-8, "dt_max": 0.1, "max_steps": 7, "method": "DormandPrince"},
    {"dt": 0.25, "method": "ETD1", "vi_solver": "Extragradient"},
    {"method": "PiecewiseLinear", "rtol": 1e-6, "max_steps": 9},
    {},
]
TANK = "C1 1 0 1u IC=10\nL1 1 0 10m\nD1 1 0 R=1k\n"
CIRCUIT = '[model]\nname = "circuit"\nnetlist = "a.cir"\nt_end = 1.0\n'


@pytest.mark.parametrize("name", APPLICATIONS)
def test_solver_options_exist_in_every_model_table(name: str) -> None:
    section = module_of(name).APPLICATION.section
    assert issubclass(section, SolverKeys) and set(section.model_fields) >= OPTIONS
    assert set(SolverSection.model_fields) == OPTIONS
    assert set(inspect.signature(dvax.solve).parameters) >= OPTIONS


@pytest.mark.parametrize("given", GIVEN)
def test_solver_options_go_to_solve_and_replace_conflicting_defaults(given) -> None:
    keywords = settings(SolverKeys.model_validate(given), rtol=1e-8, atol=1e-9, method="its own")
    for name, value in given.items():
        kind = type(keywords[name]).__name__ if name in ("method", "vi_solver") else keywords[name]
        assert kind == value
    assert ("dt" in keywords) != ("rtol" in keywords)
    assert keywords["rtol"] == given.get("rtol", 1e-8) if "dt" not in given else True


@pytest.mark.parametrize("name", APPLICATIONS)
@pytest.mark.parametrize(
    ("fix", "said"),
    [
        (Fix("rtol", "1e-6", "why"), "Write model.rtol = 1e-6, why"),
        (Fix("atol", "1e-6", "why"), "Write model.atol = 1e-6, why"),
        (Fix("max_steps", "9", "why"), "Write model.max_steps = 9, why"),
        (Fix("method", "ExpRosenbrock", "why"), 'Write model.method = "ExpRosenbrock", why'),
        (Fix("method", "Implicit", "why"), 'Write model.method = "Implicit", why'),
        (Fix("vi_solver", "Extragradient", "why"), 'Write model.vi_solver = "Extragradient", why'),
        (Fix("knots", "[1.0]", "why"), None),
        (Fix("dt0", "1.0", "why"), None),
        (Fix("", "", "Check f there"), "Check f there"),
    ],
)
def test_solver_fix_names_a_key_of_the_file_or_nothing(
    name: str, fix: Fix, said: str | None
) -> None:
    assert wording_of(module_of(name).APPLICATION, "a.toml").fix(fix) == said


@pytest.mark.parametrize(
    ("more", "place", "words"),
    [
        ("dt = 0.1\nrtol = 1e-3\n", "model.dt", "fixed by dt, or chosen for rtol"),
        ("dt = 0.1\ndt_max = 0.1\n", "model.dt", "fixed by dt, or chosen for dt_max"),
        ('dt = 0.1\nmethod = "Implicit"\n', "model.dt", "implicit"),
        ('dt = 0.1\nmethod = "PiecewiseLinear"\n', "model.dt", "Leave out dt, or"),
        ('dt_max = 0.1\nmethod = "PiecewiseLinear"\n', "model.dt_max", "Leave out dt_max, or"),
        (
            'vi_solver = "Auto"\nmethod = "PiecewiseLinear"\n', "model.vi_solver",
            "Leave out vi_solver, or",
        ),
        ("dt_max = 2.0\n", "model.dt_max", "which has 1 s"),
        ("dt_max = 1e-12\n", "model.dt_max", "more than max_steps"),
        ('method = "etd2rk"\n', "model.method", "one of ETD1, ETD2RK, ETD4RK"),
        ("max_steps = 0\n", "model.max_steps", "at least 1"),
        ("rtol = 1.0\n", "model.rtol", "less than 1"),
        ("rtoll = 1e-3\n", "model.rtoll", "Did you mean 'rtol'?"),
    ],
)  # fmt: skip
def test_solver_options_in_conflict_are_rejected(
    tmp_path: Path, more: str, place: str, words: str
) -> None:
    (tmp_path / "a.cir").write_text(TANK)
    (tmp_path / "a.toml").write_text(CIRCUIT + more)
    with pytest.raises(dvax.InputError) as caught:
        read_config(tmp_path / "a.toml")
    (problem,) = caught.value.problems
    assert problem.place == f"a.toml: {place}" and words in str(problem)
    assert "typing" not in str(problem) and "class" not in str(problem)


@pytest.mark.parametrize(
    ("given", "expected"),
    [({}, True), ({"rtol": 1e-6}, True), ({"dt": 0.1}, False), ({"dt_max": 0.1}, False),
     ({"vi_solver": "Auto"}, False), ({"method": "ETD2RK"}, False)],
)  # fmt: skip
def test_solver_step_options_require_a_stepping_method(given, expected: bool) -> None:
    assert event_driven(SolverKeys.model_validate(given)) is expected
