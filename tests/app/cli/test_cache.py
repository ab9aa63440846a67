"""The compilation cache of the command line: filled, read, and never in the way."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dvax.app.runs.compilation_cache import cache_folder

_SCRIPT = """
import jax, jax.numpy as jnp
from pathlib import Path
from dvax.app.runs.compilation_cache import cache_folder, enable_compilation_cache

def value():
    return float(jax.jit(lambda v: jnp.sin(v) + 2.0)(0.0))

enable_compilation_cache()
assert value() == 2.0
folder = jax.config.jax_compilation_cache_dir
entries = [] if folder is None else [f for f in Path(folder).iterdir() if f.is_file()]
for entry in entries:
    entry.write_bytes(b"not a program")
jax.clear_caches()
assert value() == 2.0
print(folder is not None, len(entries) > 0)
"""


def run(**variables: str) -> str:
    kept = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    ended = subprocess.run(
        [sys.executable, "-c", _SCRIPT], capture_output=True, text=True, check=False,
        env=kept | variables,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert "persistent compilation cache" not in ended.stderr
    return ended.stdout.strip()


@pytest.mark.thorough
def test_programs_are_stored_and_an_unreadable_entry_is_compiled_again(tmp_path: Path) -> None:
    assert run(XDG_CACHE_HOME=str(tmp_path)) == "True True"


@pytest.mark.thorough
def test_a_folder_that_cannot_be_made_means_no_cache(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    assert run(XDG_CACHE_HOME=str(blocked)) == "False False"


@pytest.mark.thorough
def test_the_cache_can_be_switched_off(tmp_path: Path) -> None:
    off = run(XDG_CACHE_HOME=str(tmp_path), JAX_ENABLE_COMPILATION_CACHE="false")
    assert off == "True False"


def test_the_folder_follows_the_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder().is_relative_to(tmp_path / "dvax")
