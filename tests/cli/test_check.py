"""`dvax check`: constants with their labels, sizes, and a verdict; it writes nothing."""

from pathlib import Path
from typing import Any

import pytest
from tests.cli.contact import write_config
from typer.testing import CliRunner

from dvax.cli import check as check_module
from dvax.cli.app import app
from dvax.cli.sizes import sizes
from dvax.runs.config import build_contact, load_config


def row(**changes: Any) -> dict[str, Any]:
    given = dict(
        name="gamma", symbol="γ", value=3.0, unit="um/MPa", label="eq:concrete_strong_mono"
    )
    return given | dict(status="proved", meaning="modulus of strong monotonicity of F") | changes


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    return write_config(tmp_path / "in")


def test_the_constants_are_the_paper_s_closed_forms(tree: Path) -> None:
    before = sorted(tree.parent.parent.rglob("*"))
    result = CliRunner().invoke(app, ["check", str(tree)])
    assert result.exit_code == 0, result.output
    # α = 1.5, β = 0.5, b_x = 1, b_u = 0.5, d_x = 0.2, d_u = 0.6: γ = L_F = 3, L = 2/3, L̃ = 0.6.
    shown = {line.split()[0]: line for line in result.stdout.splitlines() if line.strip()}
    assert " 3 " in shown["γ"] and "eq:concrete_strong_mono" in shown["γ"]
    assert " 0.666667 " in shown["L"] and "eq:concrete_LU_vi" in shown["L"]
    assert " 0.6 " in shown["L̃"]
    assert "eq:concrete_CT" in result.stdout
    assert "cor:incremental_stability" in result.stdout
    assert sorted(tree.parent.parent.rglob("*")) == before


def test_a_system_outside_the_class_is_said_and_refused_only_if_asked(
    tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [row(), row(symbol="η", value=-1.0, status="refuted", label="ass:x", meaning="no decay")]
    monkeypatch.setattr(check_module, "constant_rows", lambda config: rows)
    lenient = CliRunner().invoke(app, ["check", str(tree)])
    strict = CliRunner().invoke(app, ["check", str(tree), "--strict"])
    assert (lenient.exit_code, strict.exit_code) == (0, 4)
    for result in (lenient, strict):
        assert "η = -1.0 (ass:x): no decay" in result.stderr


def test_a_system_in_the_class_passes_the_strict_check(
    tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(check_module, "constant_rows", lambda config: [row()])
    result = CliRunner().invoke(app, ["check", str(tree), "--strict"])
    assert (result.exit_code, result.stderr) == (0, "")
    assert "γ         3 um/MPa  proved  eq:concrete_strong_mono" in result.stdout


def test_sizes_are_those_of_the_run(tree: Path) -> None:
    config = load_config(tree)
    rows = {name: (value, remark) for name, value, remark in sizes(config, build_contact(config))}
    assert rows["points"] == ("24", "quadrature weights add up to 10 mm")
    assert rows["frames"][0] == "9"
    assert rows["steps"][0] == "at least 20"
    assert rows["disk"][0] == f"at most {24 * 9 * 17 / 1024:.3g} KiB"


def test_memory_grows_with_the_points(tmp_path: Path) -> None:
    shown = []
    for name, points in (("small", "points = 24"), ("large", "points = 1000000")):
        changes = (("points = 24", points), ('profile = { file = "x0.npy" }', "value = 0.5"))
        config = load_config(write_config(tmp_path / name, *changes))
        table = {what: value for what, value, _ in sizes(config, build_contact(config))}
        shown.append(table["memory"])
    assert shown == ["about 450 MiB", "about 755 MiB"]
