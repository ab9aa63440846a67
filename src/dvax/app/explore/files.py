"""Exported files: a configuration, and a Python script that runs one."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

_HEAD = "# Written by dvax explore. Run it with: dvax run FILE.toml -o DIR\n"


def configuration_text(tree: Mapping[str, Any], files: Sequence[Path]) -> str:
    """Return a configuration for `dvax run`; `files`: the data that it names, which lie beside it."""
    names = ", ".join(dict.fromkeys(file.name for file in files))
    note = f"# Save it beside the first configuration, with its data: {names}\n" if names else ""
    return f"{_HEAD}{note}\n{tomli_w.dumps(tree)}"


def code_of_configuration(tree: Mapping[str, Any], source: Path, allow_code: bool = False) -> str:
    """Return a script that runs a configuration with the data beside the file `source`."""
    return f'''"""Written by dvax explore: run a configuration and print its figures."""

import sys
import tomllib
from pathlib import Path

from dvax.app.runs.compilation_cache import enable_double

enable_double()

from dvax.app.runs.applications.config import check_config
from dvax.app.runs.driver import run

# Data files are looked for in the folder of this file.
SOURCE = Path({str(source.resolve())!r})
CONFIGURATION = r"""
{tomli_w.dumps(tree).strip()}
"""

config = check_config(tomllib.loads(CONFIGURATION), SOURCE, allow_code={allow_code})
outcome = run(config, Path(sys.argv[1] if len(sys.argv) > 1 else "explored-run"))
for name, figure in outcome.summary.items():
    print(name, figure["value"], figure["unit"])
'''
