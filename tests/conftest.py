"""The environment of every test: double precision, checked shapes, repeatable random cases."""

import contextlib
import ctypes
import gc
import itertools
import os
from importlib.metadata import version
from pathlib import Path

# OpenBLAS divides even small solves among threads, and waiting threads spin: on a machine with other
# work, a frame under an earthquake took eight times the processor time of a single thread. OpenBLAS
# reads the variable when NumPy and SciPy are imported, so it is set before the other imports.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hypothesis
import jaxtyping
import pytest

ROOT = Path(__file__).parents[1]

# Tracing makes millions of objects that live as long as the run: to look through them all for garbage,
# as often as Python does by default, would take a twentieth of the time.
gc.set_threshold(100_000, 50, 50)

# Compiled programs outlive a test run, but for those that take longer to store than to compile. Through
# the environment, so that commands which tests start as processes of their own find them too.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.03")
os.environ.setdefault("MPLBACKEND", "Agg")
# Programs without the places in the source where their operations come from are lowered sooner.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
# `make thorough` tests what users run, and more of it in its time.
if os.environ.get("HYPOTHESIS_PROFILE") != "thorough":
    # XLA's older emitters compile in two thirds of the time, and LLVM without optimisation in a fifth
    # less. A program in one part takes half the mappings of one in 32 parts. XLA_FLAGS= make test does
    # without.
    flags = [
        "--xla_backend_optimization_level=0",
        "--xla_cpu_parallel_codegen_split_count=1",
    ]
    if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 12):
        # Later releases have no other emitters, and XLA ends a process on a flag that it does not know.
        flags.append("--xla_cpu_use_fusion_emitters=false")
    os.environ.setdefault("XLA_FLAGS", " ".join(flags))

if os.environ.get("DVAX_CHECK_ANNOTATIONS"):
    # Every annotation of the library is checked at each call, which takes a fifth of a test's time.
    # Continuous integration does so on the newest Python. The hook must stand before the first import
    # of dvax, hence here and not in a fixture. The application is left out: it promises an answer to
    # input of any type, and a checker would answer first.
    application = {"__init__", "app"}
    jaxtyping.install_import_hook(
        [
            f"dvax.{entry.stem}"
            for entry in sorted((ROOT / "src" / "dvax").iterdir())
            if entry.stem not in application and (entry.is_dir() or entry.suffix == ".py")
        ],
        "beartype.beartype",
    )

import jax  # noqa: E402  (its settings come from the lines above)
from tests.selection import part_of  # noqa: E402

# In this process alone: the command line has to ask for double precision by itself, and an
# environment variable would hide it if it forgot.
jax.config.update("jax_enable_x64", True)
# No array changes its precision or grows an axis unless the code says so.
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Examples are drawn from the test's own text, so that a failure comes back on every machine.
hypothesis.settings.register_profile(
    "test", deadline=None, derandomize=True, database=None, print_blob=True
)
hypothesis.settings.register_profile(
    "thorough", deadline=None, max_examples=100_000, print_blob=True
)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "test"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--part", default="1/1", help="k/n: every n-th of the tests, from number k on")


@pytest.hookimpl(trylast=True)  # after the selection by marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    chosen = part_of(items, config.getoption("--part"))
    if len(chosen) < len(items):
        kept = set(chosen)
        config.hook.pytest_deselected(items=[item for item in items if item not in kept])
        items[:] = chosen


_MAPPED, _PAGES = Path("/proc/self/maps"), Path("/proc/self/statm")
_SO_MANY, _AT_MOST = 25, 55_000
_TESTS = itertools.count(1)


@pytest.fixture(autouse=True)
def _few_programs():
    """A compiled program takes a few of the 65 530 mappings that Linux allows a process; who asks for
    more is ended by a segmentation fault within the compiler. A whole run comes close; the long checks
    also to the memory of a machine."""
    yield
    if next(_TESTS) % _SO_MANY == 0:
        if _is_near_a_limit():
            gc.unfreeze()
            jax.clear_caches()
            gc.collect()
            # glibc keeps what was freed. The memory would stay near the limit, so that every 25th
            # test dropped all programs, for five seconds and the time to compile them again.
            with contextlib.suppress(AttributeError):
                ctypes.CDLL(None).malloc_trim(0)
        # Programs stay: a search for garbage among them took up to ten seconds.
        gc.freeze()


def _is_near_a_limit() -> bool:
    if not _MAPPED.exists():
        return False
    with _MAPPED.open() as lines:
        mappings = sum(1 for _ in lines)
    # The tests run in two processes: a third of the memory for each leaves another third.
    most = os.sysconf("SC_PHYS_PAGES") // 3
    return mappings > _AT_MOST or int(_PAGES.read_text().split()[1]) > most


@pytest.fixture
def uncached():
    """Programs that are compiled here are not kept: jaxlib 0.10.2 ends the process, now and then,
    where it writes one whose loops lie very deep in each other."""
    name = "jax_persistent_cache_min_compile_time_secs"
    before = getattr(jax.config, name)
    jax.config.update(name, 1e9)
    yield
    jax.config.update(name, before)
