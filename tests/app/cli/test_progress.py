"""Progress: plain lines in a pipe, a bar on a terminal, warnings always."""

import io
from collections.abc import Iterator
from typing import Any

import pytest
from rich.console import Console

from dvax.app.cli import progress as progress_module
from dvax.app.cli.progress import progress
from dvax.app.cli.sweep import member_listener


def events(count: int) -> Iterator[dict[str, Any]]:
    yield {"event": "compiled", "compile_seconds": 1.25}
    for step in range(1, count + 1):
        yield {
            "event": "progress",
            "t": 2.0 * step / count,
            "t_end": 2.0,
            "steps": 10 * step,
            "unit": "s",
        }
    yield {"event": "warning", "message": "the [bold] step shrank"}
    yield {"event": "stopped", "message": "done"}


def test_progress_in_a_pipe_prints_a_line_per_tenth(capsys: pytest.CaptureFixture[str]) -> None:
    with progress(quiet=False) as listener:
        for event in events(1000):
            listener(event)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "compiled in 1.2 s"
    assert len([line for line in lines if line.startswith("t = ")]) == 10
    assert lines[10] == "t = 2 of 2 s, 10000 steps (100%), 0 s left"
    assert lines[11] == "warning: the [bold] step shrank"


def test_progress_of_a_model_without_segments_prints_its_stages(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = [
        {"event": "stage", "stage": "solving at rest"},
        {"event": "compiling"},
        {"event": "stage", "stage": "bounding the error"},
    ]
    with progress(quiet=False) as listener:
        for event in told:
            listener(event)
    assert capsys.readouterr().err.splitlines() == ["solving at rest", "bounding the error"]
    screen = io.StringIO()
    terminal = Console(file=screen, force_terminal=True, width=100, color_system=None)
    monkeypatch.setattr(progress_module, "console", lambda stderr: terminal)
    for end, shown in ((2, "solving at rest"), (3, "bounding the error")):
        screen.truncate(0)
        with progress(quiet=False) as listener:
            for event in told[:end]:
                listener(event)
        # What stands there last, when the bar is drawn for the last time.
        assert shown in screen.getvalue().split("\r")[-1]
        assert "compiling" not in screen.getvalue().split("\r")[-1]


def test_quiet_prints_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    with progress(quiet=True) as listener:
        for event in events(10):
            listener(event)
    assert capsys.readouterr().err == "warning: the [bold] step shrank\n"


def test_progress_on_a_terminal_is_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    terminal = Console(file=screen, force_terminal=True, width=100, color_system=None)
    monkeypatch.setattr(progress_module, "console", lambda stderr: terminal)
    with progress(quiet=False) as listener:
        for event in events(10):
            listener(event)
    shown = screen.getvalue()
    assert "compiled in 1.2 s" in shown
    assert "100 %" in shown and "t = 2 of 2 s, 100 steps" in shown
    assert "warning: the [bold] step shrank" in shown


def test_progress_uses_the_unit_of_the_model(capsys: pytest.CaptureFixture[str]) -> None:
    for unit, shown in (
        ("days", "t = 1 of 2 days, 3 steps (50%)"),
        ("", "t = 1 of 2, 3 steps (50%)"),
    ):
        with progress(quiet=False) as listener:
            listener({"event": "progress", "t": 1.0, "t_end": 2.0, "steps": 3, "unit": unit})
        assert capsys.readouterr().err.startswith(shown)


def test_progress_of_a_sweep_counts_members_and_warns_of_failures(
    capsys: pytest.CaptureFixture[str],
) -> None:
    told = [
        {"event": "started", "members": 5, "complete": 1},
        {"event": "member", "member": 1, "status": "finished"},
        {
            "event": "member",
            "member": 2,
            "status": "failed",
            "reason": "no model",
            "values": {"model.rate": 13.0},
        },
        {"event": "member", "member": 3, "status": "finished"},
        {"event": "member", "member": 4, "status": "finished"},
        {"event": "stopped", "counts": {}},
    ]
    with progress(quiet=False) as listener:
        tell = member_listener(listener)
        for event in told:
            tell(event)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "5 members, 1 complete"
    assert lines[2] == "warning: member 2 (model.rate = 13.0) failed: no model"
    shown = [line.rpartition(",")[0] for line in lines[1:2] + lines[3:]]
    assert shown == [f"{n} of 4 missing members ({25 * n}%)" for n in (1, 2, 3, 4)]
