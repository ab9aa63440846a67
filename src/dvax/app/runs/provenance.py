"""The provenance of a result: versions, machine, precision."""

import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

PACKAGES = (
    "jax",
    "jaxlib",
    "equinox",
    "diffrax",
    "numpy",
    "xarray",
    "zarr",
)


def provenance() -> dict[str, Any]:
    """Return versions of dvax and of the numerical packages, the machine and the precision."""
    device = jax.devices()[0]
    return {
        "dvax": _version("dvax"),
        "git_commit": commit(),
        "packages": {name: _version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "device": f"{device.platform}: {device.device_kind}",
        "devices": jax.device_count(),
        "precision": str(jnp.result_type(float)),
    }


@cache
def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


@cache
def commit() -> str | None:
    """Return the commit of the source tree that dvax runs from, with a + where files are modified; None
    outside of one."""
    folder = Path(__file__).resolve().parent

    def git(*words: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", "-C", str(folder), *words], capture_output=True, text=True, timeout=5
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    # Only where this file is under version control: dvax may be installed in another checkout.
    if git("ls-files", "--error-unmatch", Path(__file__).name) is None:
        return None
    head = git("rev-parse", "HEAD")
    return f"{head}+" if head and git("status", "--porcelain", "--", ".") else head
