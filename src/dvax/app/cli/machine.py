"""Facts about the machine and the installation, for people who ask why something does not work."""

import importlib.metadata
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

LIBRARY = ("jax", "jaxlib", "equinox", "diffrax", "numpy", "scipy")
APPLICATION = ("typer", "rich", "pydantic", "pint", "xarray", "zarr", "plotly", "matplotlib")
SYSTEM_PYTHON = Path("/usr/bin/python3")


def versions(names: tuple[str, ...]) -> dict[str, str | None]:
    """The installed version of each package, None where it is missing."""
    found: dict[str, str | None] = {}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def python() -> str:
    """The interpreter's version and the platform."""
    return f"{sys.version.split()[0]} on {platform.platform()}"


def cores() -> int:
    """Cores that this process may use, which a container often limits below the machine's."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory_gib() -> float | None:
    """The machine's memory in GiB, None where the system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    except (ValueError, OSError, AttributeError):
        return None


def chromium() -> str | None:
    """The path of a Chromium, None where there is none."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next(filter(None, map(shutil.which, names)), None)


def siconos() -> str | None:
    """Where Siconos is: this Python, the system's, or nowhere (None)."""
    if importlib.util.find_spec("siconos") is not None:
        return "in this Python"
    if not SYSTEM_PYTHON.is_file():
        return None
    # The system's Python has its own packages (Debian: python3-siconos); asked without importing.
    question = "import importlib.util as u, sys; sys.exit(u.find_spec('siconos') is None)"
    answer = subprocess.run(
        [str(SYSTEM_PYTHON), "-c", question], capture_output=True, timeout=20, check=False
    )
    return f"in {SYSTEM_PYTHON}" if answer.returncode == 0 else None


def unwritable(folder: Path) -> str | None:
    """Why `folder` cannot be written, None where it can."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".dvax-doctor-"):
            return None
    except OSError as error:
        return error.strerror or str(error)
