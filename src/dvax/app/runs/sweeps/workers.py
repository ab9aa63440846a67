"""The processes that run the members of a sweep: Dask workers, here or on a cluster."""

import logging
import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeVar

from dvax.app.runs.interrupt import interruptible
from dvax.app.runs.sweeps.records import read_record, write_record
from dvax.errors import input_error

_PROGRAMS = 50
"""Members that compiled, after which their programs are dropped."""

_STARTS = 3
"""How often workers are started at most: the system may end one of them at once, say for its memory."""

Value = TypeVar("Value")

_compiled = 0
_sweeps: dict[tuple[Any, ...], Any] = {}


def run_task(
    source: str, directory: str, member: int, allow_outside: bool, allow_code: bool
) -> dict[str, Any]:
    """Run a member, in a worker: the arguments are plain values, so that no code is sent."""
    from dvax.app.runs.compilation_cache import enable_compilation_cache, enable_double
    from dvax.app.runs.sweeps.member import run_member
    from dvax.app.runs.sweeps.sweep import read_sweep

    key = (source, Path(source).stat().st_mtime_ns, allow_outside, allow_code)
    if key not in _sweeps:
        enable_double()
        enable_compilation_cache()
        _sweeps.clear()
        _sweeps[key] = read_sweep(source, allow_outside=allow_outside, allow_code=allow_code)
    record = run_member(_sweeps[key], Path(directory), member)
    _drop_programs(record)
    return record


def _drop_programs(record: Mapping[str, Any]) -> None:
    """Drop the compiled programs of this process from time to time, if each member has others: they
    would take all memory."""
    global _compiled
    import jax

    _compiled += record.get("compile_seconds", 0.0) > 0.5
    if _compiled >= _PROGRAMS:
        _compiled = 0
        jax.clear_caches()


@contextmanager
def cluster(address: str | None, workers: int, threads: int) -> Iterator[Any]:
    """A Dask client: of the scheduler at this address, else of so many new processes with as many
    threads each.

    **Raises:** `dvax.InputError` if no scheduler answers.
    """
    import dask
    from distributed import Client, LocalCluster

    if address is not None:
        # `results` reports a scheduler that has ended.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        try:
            client = Client(address, timeout="20s")
        except (OSError, ValueError, TimeoutError) as error:
            raise input_error(
                "--scheduler", address, f"no Dask scheduler answers there ({error})",
                "Start one with dask scheduler, and dask worker with its address",
            ) from None  # fmt: skip
        with client:
            yield client
        return
    environment = {
        # The number of threads of XLA, which would take all cores for every worker.
        "NPROC": str(threads),
        "OMP_NUM_THREADS": str(threads),
    }

    def start(folder: str) -> tuple[Any, Any]:
        with _without_interrupts():
            local = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, memory_limit=None,
                local_directory=folder, silence_logs=50,
                # Any free port, since the usual one may be that of another cluster here.
                dashboard_address="127.0.0.1:0",
            )  # fmt: skip
            return local, Client(local)

    with (
        tempfile.TemporaryDirectory(prefix="dvax-sweep-", ignore_cleanup_errors=True) as folder,
        dask.config.set({
            "distributed.nanny.pre-spawn-environ": environment,
            "distributed.worker.memory.target": False,
            "distributed.worker.memory.spill": False,
            "distributed.worker.memory.pause": False,
            "distributed.worker.memory.terminate": False,
            # A worker that compiles or computes for long is not dead.
            "distributed.scheduler.worker-ttl": None,
            "distributed.comm.timeouts.tcp": "1 day",
        }),
    ):  # fmt: skip
        local, client = interruptible(lambda: _repeated(lambda: start(folder)))
        try:
            yield client
        except KeyboardInterrupt:
            # Closing it would wait for the members that run, longer than a user does. The workers end
            # with this process.
            _abandoned.append((local, client))
            raise
        except BaseException:
            _close(local, client)
            raise
        _close(local, client)


def _repeated(start: Callable[[], Value]) -> Value:
    """Return start(), called again where a worker ended while it started."""
    for _ in range(_STARTS - 1):
        try:
            return start()
        except RuntimeError:
            continue
    return start()


def _close(local: Any, client: Any) -> None:
    client.close()
    local.close()


_abandoned: list[Any] = []
"""Clusters that an interrupt left open."""


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """In the block this thread, and the threads and processes that it starts, do not receive SIGINT:
    Ctrl-C in a terminal reaches all processes, and the first one ends the others."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # It would unblock the signal when the first process starts. After an interrupt it would warn of the
    # semaphores of a cluster that nobody closed, which it then removes.
    kept = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = "ignore:resource_tracker:UserWarning"
    try:
        resource_tracker.ensure_running()
    finally:
        os.environ.pop("PYTHONWARNINGS")
        if kept is not None:
            os.environ["PYTHONWARNINGS"] = kept
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def results(
    client: Any, sweep: Any, directory: Path, members: Sequence[int]
) -> Iterator[dict[str, Any]]:
    """The records of these members, as they end.

    Tasks return their records, and the results are on disk: nothing is kept in the client.
    """
    from distributed import as_completed

    where = str(sweep.source.resolve()), str(directory.resolve())
    options = sweep.allow_outside, sweep.allow_code
    tasks = {client.submit(run_task, *where, k, *options, pure=False): k for k in members}
    for future, value in as_completed(tasks, with_results=True, raise_errors=False):
        member, status = tasks.pop(future), future.status
        if status == "finished":
            yield value
            continue
        if status != "error":
            raise input_error(
                "--scheduler", str(client.scheduler.address), f"its tasks are {status}: it has ended",
                "Start it again, and pass --resume to run what is missing",
            )  # fmt: skip
        # The worker died several times, or the disk refused: dvax itself leaves a record.
        error = value[1] if isinstance(value, tuple) else value
        record = {
            **(read_record(directory, member) or {"member": member}),
            "status": "failed", "exit_code": 1, "reason": f"{type(error).__name__}: {error}",
        }  # fmt: skip
        write_record(directory, record)
        yield record


def default_workers(threads: int) -> int:
    """Return how many worker processes fit on the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)) // threads)
    return max(1, (os.cpu_count() or 1) // threads)
