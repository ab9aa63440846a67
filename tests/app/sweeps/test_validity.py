"""Sweeps with invalid members: they fail, the others run, and --check lists all of them."""

import json

import pytest
from typer.testing import CliRunner

import dvax
from dvax.app.cli.program import app
from dvax.app.runs.sweeps import validity
from dvax.app.runs.sweeps.sweep import read_sweep
from dvax.app.runs.sweeps.validity import require_valid_member

from .decay import MODEL, written

LINE = 1 + MODEL.splitlines().index('        raise ValueError("this rate has no model")')
RATES = '[grid]\n"model.parameters.rate" = {}\n'


def call(file, *words):
    return CliRunner().invoke(app, ["sweep", str(file), "--allow-code", *words])


def refusal(folder, sweep):
    with pytest.raises(dvax.InputError) as caught:
        require_valid_member(read_sweep(written(folder, sweep), allow_code=True))
    return [str(problem) for problem in caught.value.problems]


def test_check_lists_all_invalid_members_with_values_file_and_line(tmp_path):
    file = written(tmp_path, RATES.format('[1.0, 13.0, "x", 2.0, "3 m"]'))
    result = call(file, "--check")
    assert result.exit_code == 2 and "3 problems in the input" in result.stderr
    told = result.stderr
    assert "sweep.toml, member 1 (model.parameters.rate = 13.0): decay.py, line " in told
    assert f"line {LINE}" in told and "this rate has no model" in told
    assert "member 2 (model.parameters.rate = 'x'): decay.toml: model.parameters.rate" in told
    assert "member 4 (model.parameters.rate = '3 m')" in told
    valid = call(written(tmp_path / "valid", RATES.format("[1.0, 2.0]")), "--check")
    assert valid.exit_code == 0 and "no problem in the input of 2 members" in valid.stdout


@pytest.mark.slow
def test_invalid_members_fail_with_their_values_and_the_others_run(tmp_path):
    file = written(tmp_path, RATES.format("[13.0, 1.0, 13.0]"))
    result = call(file, "-o", str(tmp_path / "out"), "--workers", "1")
    assert result.exit_code == 3
    assert "member 0 (model.parameters.rate = 13.0) failed: decay.py, line" in result.stderr
    lines = (tmp_path / "out" / "members.jsonl").read_text().splitlines()
    assert [json.loads(line)["status"] for line in lines] == ["failed", "finished", "failed"]


def test_sweep_without_a_valid_member_is_refused(tmp_path):
    told = refusal(tmp_path, RATES.format('["x", "y", "z"]'))
    assert "sweep.toml, member 0 (model.parameters.rate = 'x'): decay.toml" in told[0]
    assert "among 3 members" in told[-1] and "dvax sweep sweep.toml --check" in told[-1]
    (alone,) = refusal(tmp_path / "alone", RATES.format("[13.0]"))
    assert f"member 0 (model.parameters.rate = 13.0): decay.py, line {LINE}" in alone


def test_problem_that_all_members_share_is_told_once(tmp_path):
    file = written(tmp_path, RATES.format("[1.0, 2.0, 3.0]"))
    file.with_name("decay.toml").write_text('[model]\npython = "decay.py:biuld"\n')
    with pytest.raises(dvax.InputError) as caught:
        require_valid_member(read_sweep(file, allow_code=True))
    (problem,) = caught.value.problems
    assert "biuld" in problem.given and "member" not in problem.place


def test_so_many_members_are_checked_until_a_sweep_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(validity, "MOST_CHECKED", 3)
    told = refusal(tmp_path, RATES.format("{ from = -20, to = -10, count = 11 }").replace(
        "rate", "growht"
    ))  # fmt: skip
    assert "Did you mean 'growth'?" in told[0] and "among 3 members" in told[-1]
    one = RATES.format('["a", "b", "c", "d", 1.0]')
    require_valid_member(read_sweep(written(tmp_path / "last", one), allow_code=True))


def test_error_of_dvax_in_a_function_of_the_user_has_its_line(tmp_path):
    in_build = MODEL.replace(
        'raise ValueError("this rate has no model")', "dvax.sets.Box(1.0, 0.0)"
    )
    function = "lambda t, args: dvax.sets.Box(0.0, 13.5 - args['rate'])"
    # K is called when the problem is checked, after the function has returned.
    in_problem = MODEL.replace("dvax.sets.Box(0.0, 10.0)", function).replace("13.0", "-1.0")
    for model, wrong, line in (
        (in_build, "13.0", LINE),
        (in_problem, "14.0", 1 + MODEL[: MODEL.index("dvax.sets.Box")].count("\n")),
    ):
        file = written(tmp_path / wrong, RATES.format(f"[1.0, {wrong}]"), model=model)
        told = call(file, "--check").stderr
        owner = "dvax.Problem(K), " if wrong == "14.0" else ""
        place = f"(model.parameters.rate = {wrong}): {owner}decay.py, line {line}: dvax.sets.Box"
        assert place in told, told
    debug = call(file, "--check", "--debug").stderr
    assert "Traceback" in debug and "decay.py" in debug
