"""`dvax run`: results on disk, figures on the terminal, and the exit code."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.app.cli.contact import write_config
from tests.app.plots.synthetic import Recipe, write_run
from typer.testing import CliRunner

from dvax.app.cli.program import app
from dvax.app.runs import driver


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """A run of the real driver, with the output of the command."""
    folder = tmp_path_factory.mktemp("run")
    config = write_config(folder / "in")
    result = CliRunner().invoke(app, ["run", str(config), "-o", str(folder / "out")])
    return folder / "out", result


def test_run_exits_with_zero_and_writes_a_report(finished: tuple[Path, Any]) -> None:
    out, result = finished
    assert result.exit_code == 0, result.output
    assert json.loads((out / "manifest.json").read_text())["status"] == "finished"
    assert (out / "report.html").stat().st_size > 1e6
    assert {"pressure.png", "regimes.png"} <= {file.name for file in (out / "figures").iterdir()}
    assert f"report: {out / 'report.html'}" in result.stderr


def test_run_prints_the_figures_of_the_summary(finished: tuple[Path, Any]) -> None:
    out, result = finished
    summary = json.loads((out / "summary.json").read_text())
    assert summary
    for name in set(summary) - {"status"}:
        assert name in result.stdout
    assert f"{summary['status']['value']}: {summary['status']['meaning']}" in result.stderr


def test_run_prints_compile_time_separately(finished: tuple[Path, Any]) -> None:
    _, result = finished
    assert "compiled in " in result.stderr
    assert "steps" in result.stderr


def test_run_manifest_records_double_precision(finished: tuple[Path, Any]) -> None:
    out, _ = finished
    manifest = json.loads((out / "manifest.json").read_text())
    assert "64" in str(manifest["precision"])


@pytest.mark.thorough
def test_run_quiet_prints_nothing(tmp_path: Path) -> None:
    config = write_config(tmp_path / "in")
    result = CliRunner().invoke(app, ["run", str(config), "-o", str(tmp_path / "out"), "--quiet"])
    assert (result.exit_code, result.output) == (0, "")


@pytest.mark.thorough
def test_run_replaces_results_only_with_force(tmp_path: Path, finished: tuple[Path, Any]) -> None:
    config = write_config(tmp_path / "in")
    out = write_run(tmp_path / "out", Recipe((30,)))
    refused = CliRunner().invoke(app, ["run", str(config), "-o", str(out)])
    assert refused.exit_code == 2
    assert "--force" in refused.stderr
    assert json.loads((out / "manifest.json").read_text())["steps"] == 4000
    replaced = CliRunner().invoke(app, ["run", str(config), "-o", str(out), "--force"])
    assert replaced.exit_code == 0, replaced.output
    assert json.loads((out / "manifest.json").read_text())["steps"] != 4000


def test_run_force_deletes_only_files_of_dvax(tmp_path: Path) -> None:
    config = write_config(tmp_path / "in")
    out = tmp_path / "home"
    out.mkdir()
    (out / "thesis.tex").write_text("years of work")
    result = CliRunner().invoke(app, ["run", str(config), "-o", str(out), "--force"])
    assert result.exit_code == 2
    assert (out / "thesis.tex").read_text() == "years of work"


def stand_in(status: str, code: int, directory: Path) -> Callable[..., driver.RunOutcome]:
    """Replace the driver by one that stops as given, after it wrote a partial run directory."""

    def run(config: Any, out: Path, **options: Any) -> driver.RunOutcome:
        write_run(directory, Recipe((30,), frames=20, written=6, status=status))
        options["on_event"]({"event": "warning", "message": "the step shrank"})
        reason = "f returned NaN at t = 3.2, component 17."
        return driver.RunOutcome(
            status=status,
            exit_code=code,
            stop_reason=reason,
            directory=directory,
            summary={},
            has_results=True,
        )

    return run


@pytest.mark.thorough
@pytest.mark.parametrize(("status", "code"), [("failed", 3), ("interrupted", 130)])
def test_failed_run_prints_the_reason_and_keeps_its_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: str, code: int
) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr(driver, "run", stand_in(status, code, out))
    config = write_config(tmp_path / "in")
    result = CliRunner().invoke(app, ["run", str(config), "-o", str(out)])
    assert result.exit_code == code
    assert f"{status}: f returned NaN at t = 3.2, component 17." in result.stderr
    assert "warning: the step shrank" in result.stderr
    assert "Traceback" not in result.output
    assert "Partial results." in (out / "report.html").read_text(encoding="utf-8")


def test_interrupt_outside_the_run_exits_with_130(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*_: Any, **__: Any) -> driver.RunOutcome:
        raise KeyboardInterrupt

    monkeypatch.setattr(driver, "run", run)
    config = write_config(tmp_path / "in")
    result = CliRunner().invoke(app, ["run", str(config), "-o", str(tmp_path / "out")])
    assert result.exit_code == 130
    assert "Traceback" not in result.output
    shown = CliRunner().invoke(app, ["run", str(config), "-o", str(tmp_path / "out"), "--debug"])
    assert shown.exit_code == 130
    assert "Traceback" in shown.stderr
