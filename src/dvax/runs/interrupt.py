"""Signals: Ctrl-C and a request to terminate end a command within a second or two, whatever it does.

Python runs signal handlers in the main thread alone, and only between two of its own instructions: a
compiled loop or a long compilation would hold them up for as long as it takes. So long work is done in
a thread of its own, while the main thread waits and stays free to act. What the thread computes is
given up; what was finished before is the main thread's, to be written.
"""

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes by the convention of shells: 128 and the number of the signal."""

_WAIT = 0.1
"""Seconds between two looks at a thread: on Windows a wait without an end is deaf to Ctrl-C."""

Value = TypeVar("Value")


class Terminated(KeyboardInterrupt):
    """A request to terminate (SIGTERM)."""


def exit_code(stop: KeyboardInterrupt) -> int:
    """The exit code of a process that a signal ended."""
    return TERMINATED if isinstance(stop, Terminated) else INTERRUPTED


def interruptible(work: Callable[[], Value], seconds: float = math.inf) -> Value:
    """Return work(), done in another thread where this is the main one, so that signals are answered.

    `work` computes and writes nothing: after a signal, or after so many seconds, it is given up, and
    its thread goes on until the process ends.

    **Raises:** what `work` raises, `KeyboardInterrupt` at a signal, or `TimeoutError`.
    """
    if threading.current_thread() is not threading.main_thread():
        return work()
    outcome: dict[str, Any] = {}
    done = threading.Event()

    def run() -> None:
        try:
            outcome["value"] = work()
        except BaseException as error:  # noqa: BLE001 (raised again in the main thread)
            outcome["error"] = error
        finally:
            done.set()

    threading.Thread(target=run, name="dvax work", daemon=True).start()
    until = time.monotonic() + seconds
    while not done.wait(_WAIT):
        if time.monotonic() > until:
            raise TimeoutError
    if "error" in outcome:
        raise outcome["error"]
    return outcome["value"]


@contextmanager
def terminable() -> Iterator[None]:
    """Turn a request to terminate into `Terminated`, as Ctrl-C is a `KeyboardInterrupt`."""

    def interrupt(number: int, frame: Any) -> None:
        raise Terminated

    with _handling({signal.SIGTERM: interrupt}):
        yield


@contextmanager
def undisturbed() -> Iterator[None]:
    """Hold both signals up while a few files are written; one that came is raised afterwards."""
    came: list[int] = []
    with _handling(dict.fromkeys((signal.SIGINT, signal.SIGTERM), lambda n, _: came.append(n))):
        yield
    if came:
        raise Terminated if came[0] == signal.SIGTERM else KeyboardInterrupt


@contextmanager
def _handling(handlers: dict[Any, Any]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may say what signals do
        return
    # A signal that is ignored (in the background of some shells) stays ignored.
    before = {
        number: signal.signal(number, handler)
        for number, handler in handlers.items()
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
