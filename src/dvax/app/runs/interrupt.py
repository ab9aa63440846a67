"""Signals: Ctrl-C and a request to terminate end a command within about two seconds, whatever it does.

Python runs signal handlers in the main thread alone, between two of its own instructions: a compiled
loop, a long compilation or an import of C code holds them up for as long as it takes, and an exception
that a handler raises inside of foreign code may be swallowed there. Therefore:

- long work is done in a thread of its own (`Work`, `interruptible`) while the main thread waits;
- a handler only notes the signal, and the wait raises: never in the middle of a write;
- `end_within` ends the process from another thread where all of that took too long. What is on disk is
  whole at every moment, since files are renamed into place and frames count from their times on.

What a thread still computes is given up; what was finished before is the main thread's, to be written.
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
"""Seconds after a signal in which figures and the page of what was computed may still be made."""
LONGEST = 1.8
"""Seconds after a signal at which the process ends, finished or not."""
_WRITING = 8.0
"""Seconds more where results are just being written."""
_WAIT = 0.05
"""Seconds between two looks at a thread: on Windows a wait without an end is deaf to Ctrl-C."""

Value = TypeVar("Value")


class Terminated(KeyboardInterrupt):
    """A request to terminate (SIGTERM)."""


class _State:
    """The signals of this process that came and were not raised yet, and the time of the first."""

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
    """Seconds that are left of `PATIENCE` after a signal; without one, there is no hurry."""
    since = time.monotonic() - _state.first
    return math.inf if math.isinf(since) else max(0.0, PATIENCE - since)


def raise_if_asked() -> None:
    """Raise `KeyboardInterrupt`, or `Terminated`, where a signal came since the last time."""
    if _state.pending and threading.current_thread() is threading.main_thread():
        number = _state.pending[0]
        _state.pending.clear()
        raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


class Work(Generic[Value]):
    """work(), begun in another thread. `work` computes and writes nothing: after a signal it is given
    up, and its thread goes on until the process ends."""

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
        """What work() returned.

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
    """Return work(), done in another thread where this is the main one, so that signals are answered.

    **Raises:** what `Work.result` raises.
    """
    if threading.current_thread() is not threading.main_thread():
        return work()
    raise_if_asked()
    return Work(work).result(seconds)


@contextmanager
def terminable() -> Iterator[None]:
    """Within, both signals are noted, and raised by `interruptible` or at the end: Ctrl-C as
    `KeyboardInterrupt`, a request to terminate as `Terminated`."""
    if _state.active or threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may say what signals do
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
    """Within, results are written: `end_within` waits for them, though not for long."""
    _state.writing += 1
    try:
        yield
    finally:
        _state.writing -= 1


def end_within(seconds: float) -> None:
    """From now on, end this process so many seconds after the first of both signals, from a thread of
    its own: the last resort, where the main thread is held up in foreign code."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    # Written to by Python's handler in C, whatever the main thread is doing.
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
