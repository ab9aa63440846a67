"""A description of the machine on which the figures were measured."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

PACKAGES = ("jax", "diffrax", "equinox", "numpy", "scipy")
ROOT = Path(__file__).parents[1]


def facts() -> dict[str, str]:
    """Processor, cores, system, versions; the commit where the folder is a repository."""
    versions = {name: _version(name) for name in ("dvax", *PACKAGES)}
    return {
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity")
                     else os.cpu_count() or 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        **versions,
        "commit": _commit(),
    }  # fmt: skip


def load() -> str:
    """The load averages over 1, 5 and 15 minutes; "unknown" where the system has none."""
    if not hasattr(os, "getloadavg"):
        return "unknown"
    return ", ".join(f"{value:.2f}" for value in os.getloadavg())


def _version(package: str) -> str:
    if package == "dvax":
        import dvax

        return dvax.__version__
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "absent"


def _processor() -> str:
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        for line in listing.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _commit() -> str:
    try:
        answer = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"],
            cwd=ROOT, capture_output=True, text=True, timeout=10, check=False,
        )  # fmt: skip
    except OSError:
        return "unknown"
    return answer.stdout.strip() or "unknown"
