"""Facts about the machine and the installation, for finding out why something does not work."""

import importlib.metadata
import os
import platform
import re
import shutil
import sys
import tempfile
from pathlib import Path

LIBRARY = ("jax", "jaxlib", "equinox", "diffrax", "optimistix", "numpy", "scipy")
APPLICATION = (
    "typer", "rich", "pydantic", "pint", "xarray", "zarr", "h5netcdf", "dask", "plotly", "matplotlib",
)  # fmt: skip
NOT_FOR_USERS = ("app", "dev", "docs")
"""Extras that are listed package by package, or of which no command of a user depends."""
_VARIABLES = ("JAX_", "XLA_", "CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def versions(names: tuple[str, ...]) -> dict[str, str | None]:
    """The installed version of each package, None where it is missing."""
    found: dict[str, str | None] = {}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def extras() -> dict[str, dict[str, str | None]]:
    """The packages of each optional extra of dvax with their versions, from its metadata."""
    found: dict[str, dict[str, str | None]] = {}
    for line in importlib.metadata.requires("dvax") or []:
        match = re.fullmatch(r"([A-Za-z0-9_.-]+).*;.*\bextra == ['\"]([\w-]+)['\"]", line)
        if match and match[2] not in NOT_FOR_USERS:
            found.setdefault(match[2], {}).update(versions((match[1],)))
    return found


def python() -> str:
    """The interpreter's version and the platform."""
    return f"{sys.version.split()[0]} on {platform.platform()}"


def processor() -> str:
    """The model of the processor, if the system reports it."""
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        lines = listing.read_text(encoding="utf-8", errors="replace").splitlines()
        named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        if named:
            return named[0]
    return platform.processor() or platform.machine()


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


def variables() -> dict[str, str]:
    """The environment variables that change how JAX and its threads compute."""
    return {name: os.environ[name] for name in sorted(os.environ) if name.startswith(_VARIABLES)}


def free_gib(folder: Path) -> float:
    """The free space in GiB where `folder` is, or will be."""
    there = next(p for p in (folder, *folder.parents) if p.exists())
    return shutil.disk_usage(there).free / 2**30


def unwritable(folder: Path) -> str | None:
    """Why `folder` cannot be written, None where it can."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".dvax-doctor-"):
            return None
    except OSError as error:
        return error.strerror or str(error)
