"""JAX's compilation cache on disk, so that the second run of a model does not compile.

An entry is a compiled program for one processor. JAX's key of an entry does not contain the processor,
so the name of the folder does, with the versions. JAX compiles a program whose entry it cannot read,
and continues without an entry that it cannot write.
"""

import hashlib
import os
import platform
import sys
import warnings
from importlib.metadata import version
from pathlib import Path


def enable_compilation_cache() -> None:
    """Keep compiled programs in the user's cache folder.

    `JAX_COMPILATION_CACHE_DIR` names another folder, and `JAX_ENABLE_COMPILATION_CACHE=false` switches
    the cache off. Without a folder that can be written there is no cache.
    """
    import jax

    # A run does not depend on the cache, so its user need not read of an entry that failed.
    warnings.filterwarnings(
        "ignore", message="Error (reading|writing) persistent compilation cache"
    )
    # Some entries take milliseconds to compile, but a run has dozens of them.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    folder = cache_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return
    if _is_own(folder):
        jax.config.update("jax_compilation_cache_dir", str(folder))


def enable_double() -> None:
    """Switch JAX of this process to 64-bit numbers, which the library never does by itself. The
    manifest of a run records it."""
    import jax

    jax.config.update("jax_enable_x64", True)


def cache_folder() -> Path:
    """Return the folder for these versions of dvax and JAX on this processor."""
    from dvax import __version__

    processor = hashlib.sha256(_processor().encode()).hexdigest()[:12]
    packages = "-".join(f"{name}{version(name)}" for name in ("jax", "jaxlib"))
    name = f"{__version__}-{packages}-{processor}"
    return _user_cache() / "dvax" / "programs" / name


def _user_cache() -> Path:
    """Return the user's cache folder: that of the XDG rule, or of the system."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(given):
        return Path(given)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    local = os.environ.get("LOCALAPPDATA")
    if sys.platform == "win32" and local:
        return Path(local)
    return Path.home() / ".cache"


def _processor() -> str:
    """Return the model of the processor with its instruction sets, if the system reports them."""
    text = f"{platform.machine()} {platform.processor()}"
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        lines = listing.read_text(encoding="utf-8", errors="replace").splitlines()
        kinds = ("model name", "flags", "Features")
        text += "".join(sorted({line for line in lines if line.startswith(kinds)}))
    return text


def _is_own(folder: Path) -> bool:
    """Return whether this user alone can write to the folder: its programs are executed."""
    if not os.access(folder, os.W_OK):
        return False
    if not hasattr(os, "getuid"):
        return True
    status = folder.stat()
    return status.st_uid == os.getuid() and not status.st_mode & 0o022
