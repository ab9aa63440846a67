"""Signals: SIGINT (Ctrl-C) and SIGTERM end a command within about two seconds, whatever it does.

Python runs signal handlers in the main thread only, between two bytecode instructions: a compiled loop,
a compilation or an import of a C extension delays them until it ends, and foreign code may swallow an
exception that a handler raises. Therefore:

- long work runs in another thread (`Work`, `interruptible`) while the main thread waits;
- a handler only records the signal, and the wait raises: never in the middle of a write;
- `end_within` ends the process from another thread where that takes too long. The files on disk are
  complete at every moment: they are renamed into place, and a frame counts once its time is written.

Work that is still running is abandoned; the main thread writes what was finished before.
"""

import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes by the convention of shells: 128 and the number of the signal."""

PATIENCE = 1.2
"""Seconds after a signal in which the figures and the page of partial results may still be computed."""
LONGEST = 1.8
"""Seconds after a signal at which the process ends, finished or not."""
_WRITING = 8.0
"""Additional seconds while results are being written."""
_WAIT = 0.05
"""Seconds between two polls of a thread: on Windows an unlimited wait ignores Ctrl-C."""

Value = TypeVar("Value")


class Terminated(KeyboardInterrupt):
    """A request to terminate (SIGTERM)."""


class _State:
    """The signals of this process that were received and not raised yet, and the time of the first."""

    def __init__(self) -> None:
        self.active = False
        self.pending: list[int] = []
        self.first = -math.inf
        self.writing = 0


_state = _State()


def exit_code(stop: KeyboardInterrupt) -> int:
    """The exit code of a process that a signal ended."""
    return TERMINATED if isinstance(stop, Terminated) else INTERRUPTED


def patience() -> float:
    """Return the seconds left of `PATIENCE` after a signal; infinite without one."""
    since = time.monotonic() - _state.first
    return math.inf if math.isinf(since) else max(0.0, PATIENCE - since)


def raise_if_asked() -> None:
    """Raise `KeyboardInterrupt` or `Terminated` where a signal was received since the last call."""
    if _state.pending and threading.current_thread() is threading.main_thread():
        number = _state.pending[0]
        _state.pending.clear()
        raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


class Work(Generic[Value]):
    """A call of `work` in another thread. `work` writes nothing: after a signal it is abandoned,
    and its thread runs until the process ends."""

    def __init__(self, work: Callable[[], Value]):
        self._outcome: dict[str, Any] = {}
        self._done = threading.Event()

        def run() -> None:
            try:
                self._outcome["value"] = work()
            except BaseException as error:  # noqa: BLE001 (raised again by `result`)
                self._outcome["error"] = error
            finally:
                self._done.set()

        threading.Thread(target=run, name="dvax work", daemon=True).start()

    def result(self, seconds: float = math.inf) -> Value:
        """Wait for the value of `work`.

        **Raises:** what work() raised, `KeyboardInterrupt` at a signal, or after so many seconds
        `TimeoutError`.
        """
        until = time.monotonic() + seconds
        while not self._done.wait(_WAIT):
            raise_if_asked()
            if time.monotonic() > until:
                raise TimeoutError
        if "error" in self._outcome:
            raise self._outcome["error"]
        return self._outcome["value"]


def interruptible(work: Callable[[], Value], seconds: float = math.inf) -> Value:
    """Return work(), called in another thread where this is the main one, so that signals are handled.

    **Raises:** what `Work.result` raises.
    """
    if threading.current_thread() is not threading.main_thread():
        return work()
    raise_if_asked()
    return Work(work).result(seconds)


@contextmanager
def terminable() -> Iterator[None]:
    """In the block both signals are recorded, and raised by `interruptible` or at the end: SIGINT as
    `KeyboardInterrupt`, SIGTERM as `Terminated`."""
    if _state.active or threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set signal handlers
        return

    def note(number: int, frame: Any) -> None:
        if math.isinf(_state.first):
            _state.first = time.monotonic()
        _state.pending.append(number)

    _state.active, _state.first = True, -math.inf
    _state.pending.clear()
    # A signal that is ignored (in the background of some shells) stays ignored.
    before = {
        number: signal.signal(number, note)
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _state.active, _state.first = False, -math.inf
    raise_if_asked()


@contextmanager
def writing() -> Iterator[None]:
    """In the block results are written: `end_within` waits a few seconds for them."""
    _state.writing += 1
    try:
        yield
    finally:
        _state.writing -= 1


def end_within(seconds: float) -> None:
    """End this process so many seconds after the first of both signals, from another thread: the last
    resort where foreign code blocks the main thread."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    # Python's C handler writes to it, even while the main thread is blocked.
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)

    def watch() -> None:
        number = os.read(read, 1)[0]
        while number not in (signal.SIGINT, signal.SIGTERM):
            number = os.read(read, 1)[0]
        end = time.monotonic() + seconds
        while time.monotonic() < end + (_WRITING if _state.writing else 0.0):
            time.sleep(_WAIT)
        os._exit(128 + number)

    threading.Thread(target=watch, name="dvax end", daemon=True).start()
