"""Threads that run a compiled program for one piece of the members after the other."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from typing import Any, TypeVar

import jax

Piece = TypeVar("Piece")
Found = TypeVar("Found")


def device_list(devices: Sequence[Any] | None) -> list[Any]:
    """Return a device for each thread: all local ones; the processor once for each of its cores, if it
    is the only one. (A program for it computes in the thread that calls it.)"""
    found = list(jax.local_devices() if devices is None else devices)
    if len(found) == 1 and found[0].platform == "cpu":
        return found * _cores()
    return found


def _cores() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every operating system
        return os.cpu_count() or 1


def in_order(
    pieces: Sequence[Piece], run: Callable[[Piece, Any], Found], devices: Sequence[Any]
) -> Iterator[Found]:
    """Yield run(piece, device) for each piece, in their order: the first in this thread, which compiles
    the program, the others in a thread for each device, a few pieces ahead."""
    if not pieces:
        return
    yield run(pieces[0], devices[0])
    rest = pieces[1:]
    if len(devices) == 1 or not rest or not _has_same_precision():
        for piece in rest:
            yield run(piece, devices[0])
        return
    free: SimpleQueue[Any] = SimpleQueue()
    for device in devices:
        free.put(device)

    def work(piece: Piece) -> Found:
        device = free.get()
        try:
            return run(piece, device)
        finally:
            free.put(device)

    pool = ThreadPoolExecutor(len(devices), "dvax ensemble")
    waiting: list[Future[Found]] = []
    try:
        ahead = 2 * len(devices)
        for k in range(len(rest)):
            while len(waiting) < ahead and k + len(waiting) < len(rest):
                waiting.append(pool.submit(work, rest[k + len(waiting)]))
            yield waiting.pop(0).result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _has_same_precision() -> bool:
    """Return whether other threads compute in the precision of this one: `jax.enable_x64` as a context
    manager holds for one thread."""
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(jax.config.read, "jax_enable_x64").result()
    return other == jax.config.read("jax_enable_x64")
