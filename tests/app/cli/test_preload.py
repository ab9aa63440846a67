"""What the report needs is loaded once the run compiles, and not where it does not."""

import sys
import threading
from typing import Any

import pytest

from dvax.app.cli.preload import preload_when_compiling

MODULE = "colorsys"  # in the standard library, and without consequences


@pytest.fixture(autouse=True)
def unloaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, MODULE, raising=False)


def loaded() -> None:
    """Wait for whatever is being loaded, as a program that ends does not."""
    for thread in threading.enumerate():
        if thread.name == "dvax preload":
            thread.join()


def test_events_pass_and_the_first_compilation_loads_the_module() -> None:
    heard: list[dict[str, Any]] = []
    listen = preload_when_compiling(MODULE, heard.append)
    listen({"event": "warning", "message": "w"})
    assert MODULE not in sys.modules
    listen({"event": "compiling"})
    listen({"event": "compiled", "compile_seconds": 1.0})
    loaded()
    assert MODULE in sys.modules
    assert [event["event"] for event in heard] == ["warning", "compiling", "compiled"]


def test_a_run_that_never_compiles_loads_nothing() -> None:
    listen = preload_when_compiling(MODULE, lambda event: None)
    listen({"event": "stopped", "message": "m", "status": "finished"})
    loaded()
    assert MODULE not in sys.modules


def test_a_module_that_is_missing_is_left_to_its_use_to_report() -> None:
    listen = preload_when_compiling("no_such_module_anywhere", lambda event: None)
    listen({"event": "compiling"})
    loaded()
    with pytest.raises(ModuleNotFoundError):
        import no_such_module_anywhere  # noqa: F401  # pyright: ignore[reportMissingImports]
