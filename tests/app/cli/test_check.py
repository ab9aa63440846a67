"""`dvax check`: constants with their labels, sizes, and a verdict; it writes nothing."""

from pathlib import Path
from typing import Any

import pytest
from tests.app.cli.contact import write_config
from typer.testing import CliRunner

from dvax.app.cli.overview import sizes
from dvax.app.cli.program import app
from dvax.app.runs import contact_frames
from dvax.app.runs.config import build_contact, load_config


def row(name: str, **changes: Any) -> dict[str, Any]:
    given = dict(name=name, symbol=name, value=1.0, unit="", label="ass:x", status="proved")
    return given | dict(meaning="a modulus") | changes


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    return write_config(tmp_path / "in")


def test_check_prints_the_constants_of_the_paper(tree: Path) -> None:
    before = sorted(tree.parent.parent.rglob("*"))
    result = CliRunner().invoke(app, ["check", str(tree)])
    assert result.exit_code == 0, result.output
    # α = 1.5, β = 0.5, b_x = 1, b_u = 0.5, d_x = 0.2, d_u = 0.6: γ = L_F = 3, L = 2/3, L̃ = 0.6.
    shown = {line.split()[0]: line for line in result.stdout.splitlines() if line.strip()}
    assert " 3 um/MPa " in shown["γ"] and "ass:strong_pseudomono" in shown["γ"]
    assert " 0.666667 " in shown["L"] and "eq:LU_def" in shown["L"]
    assert " 0.6 1/s " in shown["L̃"]
    # The growth rate is negative, so C_T = 1 + L; at ρ = β the paper has q_ρ = b_u.
    assert " 1.66667 " in shown["C_T"] and "cor:hadamard_wellposed" in shown["C_T"]
    assert " 0.5 " in shown["q_ρ"]
    assert "0.9 1/s" in shown["η"] and "cor:incremental_stability" in shown["η"]
    assert sorted(tree.parent.parent.rglob("*")) == before


def test_check_prints_assumptions_with_reasons(tree: Path) -> None:
    result = CliRunner().invoke(app, ["check", str(tree), "--strict"])
    assert result.exit_code == 0, result.output
    text = result.stdout
    assert "one response at every state  holds, proved" in text
    assert "certified decay              holds, proved" in text
    assert "projection route             holds, proved" in text


def test_check_accepts_a_system_without_decay(tmp_path: Path) -> None:
    # d_x + d_u b_x/(1 + b_u) = 2.4 > α = 1.5: no certified decay, and the run is as well posed.
    changes = (("d_x = 0.2", "d_x = 2.0"), ("b_u = 0.5", "b_u = 1.5"))
    tree = write_config(tmp_path / "in", *changes)
    result = CliRunner().invoke(app, ["check", str(tree), "--strict"])
    assert result.exit_code == 0, result.output
    assert "certified decay              does not hold" in result.stdout
    assert "projection route             does not hold" in result.stdout


@pytest.mark.thorough
@pytest.mark.parametrize("refuted", [row("gamma", status="refuted"), row("gamma", value=-1.0)])
def test_check_strict_rejects_a_system_outside_the_class(
    tree: Path, monkeypatch: pytest.MonkeyPatch, refuted: dict[str, Any]
) -> None:
    rows = [refuted, row("decay_rate"), row("q_rho")]
    monkeypatch.setattr(contact_frames, "constant_rows", lambda *given: rows)
    lenient = CliRunner().invoke(app, ["check", str(tree)])
    strict = CliRunner().invoke(app, ["check", str(tree), "--strict"])
    assert (lenient.exit_code, strict.exit_code) == (0, 4)
    for result, word in ((lenient, "warning"), (strict, "error")):
        assert f"{word}: outside the class of the theory: gamma" in result.stderr


@pytest.mark.thorough
def test_check_ends_with_an_error_where_a_set_becomes_empty(tmp_path: Path) -> None:
    folder = tmp_path / "new"
    assert CliRunner().invoke(app, ["new", str(folder)]).exit_code == 0
    code = folder / "spring.py"
    bounds = '-args["limit"], args["limit"]'
    assert bounds in code.read_text()
    code.write_text(code.read_text().replace(bounds, '-args["limit"], 2.0 - 2.0 * t'))
    command = ["check", str(folder / "spring.toml"), "--allow-code"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 4
    # Box(-5, 2 - 2 t) is empty from t = 3.5 on.
    assert "error: ass:operators (iii)" in result.stderr


def test_check_prints_the_sizes_of_the_run(tree: Path) -> None:
    config = load_config(tree)
    rows = {name: (value, remark) for name, value, remark in sizes(config, build_contact(config))}
    assert rows["points"] == ("24", "quadrature weights add up to 10 mm")
    assert rows["frames"][0] == "9"
    assert rows["steps"][0] == "at least 20"
    assert rows["disk"][0] == f"at most {24 * 9 * 17 / 1024:.3g} KiB"


def test_check_memory_estimate_grows_with_the_points(tmp_path: Path) -> None:
    shown = []
    for name, points in (("small", "points = 24"), ("large", "points = 1000000")):
        changes = (("points = 24", points), ('profile = { file = "x0.npy" }', "value = 0.5"))
        config = load_config(write_config(tmp_path / name, *changes))
        table = {what: value for what, value, _ in sizes(config, build_contact(config))}
        shown.append(table["memory"])
    assert shown == ["about 550 MiB", "about 1.28 GiB"]
