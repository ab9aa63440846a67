"""Bad input: exit code 2, every problem with its place, rule and fix; nothing is written."""

from pathlib import Path

import pytest
from tests.app.cli.contact import CSV, write_config
from typer.testing import CliRunner

from dvax.app.cli.program import app

KAPPA, BETA = 'kappa0 = "0.8 MPa"', 'beta = "0.5 MPa/um"'
EXPRESSION = 'expression = "2 + 1.5*sin(2*pi*s/10)"'

# name: (changes to the configuration, what the message must name)
SPOILED: dict[str, tuple[tuple[tuple[str, str], ...], tuple[str, ...]]] = {
    "unknown key": ((("b_u = 0.5", "bu = 0.5"),), ("model.bu", "b_u")),
    "unknown section": ((("[time]", "[tiem]"),), ("tiem", "time")),
    "unknown method": ((("dt = 0.05", 'dt = 0.05\nmethod = "ETD2"'),), ("solver.method", "ETD2RK")),
    "wrong type": ((("b_x = 1.0", "b_x = true"),), ("model.b_x",)),
    "text for a count": ((("points = 24", 'points = "24"'),), ("boundary.points",)),
    "wrong unit": (((KAPPA, 'kappa0 = "0.8 mm"'),), ("model.kappa0", "mm")),
    "unknown unit": (((KAPPA, 'kappa0 = "0.8 Mpaskal"'),), ("model.kappa0", "Mpaskal")),
    "NaN": ((("d_x = 0.2", "d_x = nan"),), ("model.d_x",)),
    "infinity": ((("d_u = 0.6", "d_u = inf"),), ("model.d_u",)),
    "no capacity": (((KAPPA, "kappa0 = 0.0"),), ("model.kappa0",)),
    "negative capacity": (((KAPPA, "kappa0 = -1.0"),), ("model.kappa0", "-1")),
    "no scaling": (((BETA, "beta = 0.0"),), ("model.beta",)),
    "negative self-feedback": ((("b_u = 0.5", "b_u = -0.1"),), ("model.b_u", "-0.1")),
    "time backward": ((("end = 1.0", "end = -1.0"),), ("time.end",)),
    "no time": ((("end = 1.0", "end = 0.0"),), ("time.end",)),
    "no frames": ((("frames = 8", "frames = 0"),), ("time.frames",)),
    "step and tolerance": ((("dt = 0.05", "dt = 0.05\nrtol = 1e-6"),), ("solver",)),
    "no demand": ((("[demand]", "[demmand]"),), ("demmand", "demand")),
    "load too short": ((("end = 1.0", "end = 5.0"),), ("load", "load.csv")),
    "missing file": ((('file = "load.csv"', 'file = "lod.csv"'),), ("load.series.file", "lod.csv")),
    "file outside": ((('file = "load.csv"', 'file = "../load.csv"'),), ("load.series.file",)),
    "missing column": ((('column = "rate"', 'column = "rat"'),), ("rat", "rate")),
    "attribute": (((EXPRESSION, 'expression = "s.real"'),), ("demand.expression",)),
    "call": (((EXPRESSION, "expression = \"__import__('os')\""),), ("demand.expression",)),
    "keyword": (((EXPRESSION, 'expression = "sin(x=s)"'),), ("demand.expression",)),
    "lambda": (((EXPRESSION, 'expression = "(lambda: 1)()"'),), ("demand.expression",)),
    "unknown name": (((EXPRESSION, 'expression = "sinn(s)"'),), ("demand.expression", "sin")),
    "bomb": (((EXPRESSION, 'expression = "9**9**9**9"'),), ("demand.expression",)),
    "not finite": (((EXPRESSION, 'expression = "1/(s-s)"'),), ("demand", "1/(s-s)")),
    "steps beyond max_steps": ((("dt = 0.05", "dt_max = 1e-12"),), ("solver.dt_max", "max_steps")),
    "no such precision": ((("dt = 0.05", "rtol = 1e-300"),), ("solver.rtol", "2.3e-14")),
    "start that overflows": (((KAPPA, "kappa0 = 1e308"),), ("initial.companion", "inf")),
    "profile beside a fine boundary": (
        (("points = 24", "points = 100000000"),),
        ("initial.profile", "24", "100000000"),
    ),
    "syntax of TOML": ((("[model]", "[model"),), ("strip.toml", "line")),
}

TABLES = {
    "gap": ("0.4,3.0", "0.4,"),
    "text in a number column": ("0.4,3.0", "0.4,three"),
    "NaN in a table": ("0.4,3.0", "0.4,nan"),
    "reversed time": ("0.7,-2.0", "0.3,-2.0"),
    "repeated time": ("0.7,-2.0", "0.4,-2.0"),
    "ragged row": ("0.4,3.0", "0.4,3.0,1.0"),
    "missing unit": ("rate [um/s]", "rate"),
}


def refused(config: Path, out: Path, *named: str) -> str:
    """Assert that `run` and `check` report everything in `named`, and write nothing."""
    before = sorted(out.parent.rglob("*"))
    for command in (["run", str(config), "-o", str(out)], ["check", str(config)]):
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 2, result.output
        assert result.stdout == ""
        assert "Traceback" not in result.output
        for text in (*named, "given:", "rule:", "fix:"):
            assert text in result.stderr
    assert sorted(out.parent.rglob("*")) == before
    return result.stderr


@pytest.mark.parametrize("name", SPOILED)
def test_run_rejects_an_invalid_configuration(tmp_path: Path, name: str) -> None:
    changes, named = SPOILED[name]
    refused(write_config(tmp_path / "in", *changes), tmp_path / "out", *named)


@pytest.mark.parametrize("name", TABLES)
def test_run_rejects_an_invalid_table_with_its_line(tmp_path: Path, name: str) -> None:
    config = write_config(tmp_path / "in", csv=CSV.replace(*TABLES[name]))
    refused(config, tmp_path / "out", "load.csv")


def test_run_with_an_initial_state_of_wrong_length_names_both_lengths(tmp_path: Path) -> None:
    config = write_config(tmp_path / "in", x0=23)
    refused(config, tmp_path / "out", "initial", "23", "24")


def test_run_reports_all_errors_at_once_including_the_output_folder(tmp_path: Path) -> None:
    config = write_config(
        tmp_path / "in",
        (KAPPA, "kappa0 = -1.0"),
        ("b_u = 0.5", "bu = 0.5"),
        ("end = 1.0", "end = 0.0"),
    )
    out = tmp_path / "out"
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    result = CliRunner().invoke(app, ["run", str(config), "-o", str(out)])
    assert result.exit_code == 2
    for named in ("model.kappa0", "model.bu", "time.end", str(out)):
        assert named in result.stderr
    assert [file.name for file in out.iterdir()] == ["precious.txt"]


def test_missing_configuration_is_an_input_error(tmp_path: Path) -> None:
    refused(tmp_path / "none.toml", tmp_path / "out", "none.toml")


def test_errors_in_a_pipe_are_printed_one_line_per_fact(tmp_path: Path) -> None:
    config = write_config(tmp_path / "in", (KAPPA, "kappa0 = -1.0"))
    text = refused(config, tmp_path / "out", "model.kappa0")
    lines = [line for line in text.splitlines() if line]
    assert lines[0] == "error: 1 problem in the input; nothing was written"
    assert [line.split(":")[0].strip() for line in lines[2:]] == ["given", "rule", "fix"]
    assert "\x1b" not in text


def test_file_instead_of_a_run_directory_is_reported_as_a_file(tmp_path: Path) -> None:
    config = write_config(tmp_path / "in")
    result = CliRunner().invoke(app, ["report", str(config)])
    assert result.exit_code == 2 and "a file, not a folder" in result.stderr
