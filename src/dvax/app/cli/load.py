"""A configuration, read and checked in double precision."""

from pathlib import Path
from typing import TYPE_CHECKING

from dvax.app.runs.compilation_cache import enable_compilation_cache, enable_double

if TYPE_CHECKING:
    from dvax.app.runs.applications.config import ModelConfig
    from dvax.app.runs.config import Config


def load(
    file: Path, allow_outside: bool, quiet: bool = False, allow_code: bool = False
) -> "Config | ModelConfig":
    """Import JAX and read `file`. Takes seconds: call it by `interruptible`.

    **Raises:** `dvax.InputError`.
    """
    enable_double()
    enable_compilation_cache()
    from dvax.app.runs.applications.config import read_config

    return read_config(file, allow_outside=allow_outside, quiet=quiet, allow_code=allow_code)
