"""Facts about the machine and the installation, for finding out why something does not work."""

import importlib.metadata
import os
import platform
import sys
import tempfile
from pathlib import Path

LIBRARY = ("jax", "jaxlib", "equinox", "diffrax", "numpy", "scipy")
APPLICATION = ("typer", "rich", "pydantic", "pint", "xarray", "zarr", "plotly", "matplotlib")


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


def unwritable(folder: Path) -> str | None:
    """Why `folder` cannot be written, None where it can."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".dvax-doctor-"):
            return None
    except OSError as error:
        return error.strerror or str(error)
