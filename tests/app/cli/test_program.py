"""The program: fast help, messages without tracebacks, and correct exit codes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.app.plots.synthetic import Recipe, write_run
from typer.testing import CliRunner

import dvax
from dvax import __version__
from dvax.app.cli import machine, selftest
from dvax.app.cli.program import app

HEAVY = ("jax", "numpy", "pydantic", "plotly", "matplotlib", "xarray", "zarr", "pint", "diffrax")


def python(code: str) -> subprocess.CompletedProcess[str]:
    paths = [str(Path(dvax.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))},
    )


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["check", "--help"]])
def test_help_imports_no_large_packages(arguments: list[str]) -> None:
    # Typer itself looks for pydantic when it builds a command with arguments.
    heavy = [name for name in HEAVY if not (name == "pydantic" and "check" in arguments)]
    code = (
        f"import sys; sys.argv = ['dvax', *{arguments!r}]\n"
        "from dvax.app.cli import main\n"
        "try: main()\n"
        "except SystemExit as end: assert not end.code, end.code\n"
        f"print('HEAVY', [name for name in {heavy!r} if name in sys.modules])\n"
    )
    done = python(code)
    assert done.stdout.splitlines()[-1:] == ["HEAVY []"], done.stdout + done.stderr


def test_program_lists_its_commands() -> None:
    shown = CliRunner().invoke(app, ["--help"]).output
    for command in (
        "new",
        "check",
        "run",
        "resume",
        "report",
        "explore",
        "export",
        "demo",
        "doctor",
    ):
        assert f"\n  {command} " in shown


def test_version_option_prints_the_package_version() -> None:
    result = CliRunner().invoke(app, ["--version"])
    assert (result.exit_code, result.stdout) == (0, f"dvax {__version__}\n")


def test_python_m_dvax_is_the_command_line() -> None:
    command = [sys.executable, "-m", "dvax", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == f"dvax {__version__}\n"


def test_shell_completes_commands() -> None:
    asked = {"_DVAX_COMPLETE": "complete_bash", "COMP_WORDS": "dvax re", "COMP_CWORD": "1"}
    command = [
        sys.executable,
        "-c",
        "import sys; sys.argv = ['dvax']; import dvax.app.cli as c; c.main()",
    ]
    done = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | asked, check=True
    )
    assert done.stdout.split() == ["resume", "report"]


@pytest.mark.parametrize("arguments", [["nonsense"], ["run"], ["run", "a.toml"], ["report", "--x"]])
def test_wrong_usage_has_the_exit_code_of_bad_input(arguments: list[str]) -> None:
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "Traceback" not in result.output


def test_missing_app_packages_give_an_error_with_the_fix() -> None:
    code = "import sys; sys.modules['typer'] = None\nfrom dvax.app.cli import main\nmain()\n"
    done = python(code)
    assert done.returncode == 1
    assert "pip install 'dvax[app]'" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_report_writes_and_prints_the_path_of_the_page(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((30,), frames=5))
    result = CliRunner().invoke(app, ["report", str(run_dir)])
    assert result.exit_code == 0, result.output
    assert result.stdout.strip() == str(run_dir / "report.html")
    assert (run_dir / "report.html").is_file()


def test_report_rejects_a_folder_that_is_not_a_run_directory(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["report", str(tmp_path)])
    assert result.exit_code == 2
    assert "manifest.json" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_doctor_self_test_uses_the_published_number() -> None:
    assert abs(selftest.EXACT - 1.8360919559905713) < 1e-15


@pytest.mark.slow
def test_doctor_reports_success() -> None:
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 0, result.output
    for what in ("dvax", "jax", "plotly", "devices", "double", "passed", "processor", "GiB free"):
        assert what in result.stdout
    for what in ("extra energy", "extra parquet", "compiled programs", "JAX_COMPILATION_CACHE_DIR"):
        assert what in result.stdout


def test_doctor_prints_json_and_the_command_for_a_missing_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "dvax.app.cli.doctor.self_test", lambda: selftest.SelfTest(selftest.EXACT, 0.0, 0.1)
    )
    monkeypatch.setattr(machine, "extras", lambda: {"fem": {"meshio": None, "scikit-fem": "12.0"}})
    result = CliRunner().invoke(app, ["doctor", "--json"])
    facts = json.loads(result.stdout)["facts"]
    assert facts["dvax"]["found"] == __version__
    assert facts["extra fem"] == {
        "found": "scikit-fem 12.0", "remark": "incomplete: pip install 'dvax[fem]'",
    }  # fmt: skip


def test_doctor_detects_a_wrong_result(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "dvax.app.cli.doctor.self_test", lambda: selftest.SelfTest(1.8, 3.6e-2, 0.1)
    )
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 3
    assert "off by 3.60e-02" in result.stderr


@pytest.mark.slow
def test_doctor_names_a_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "APPLICATION", ("typer", "a-package-that-is-not-there"))
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 3
    assert "a-package-that-is-not-there is not installed" in result.stderr


def test_unwritable_folder_is_reported_as_such(tmp_path: Path) -> None:
    assert machine.unwritable(tmp_path) is None
    assert machine.unwritable(tmp_path / "none") is not None
