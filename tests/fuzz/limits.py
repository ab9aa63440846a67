"""The promise about any input: it is read, or refused by an `InputError`, within limits.

`examine` runs one reading of input and returns None where the promise holds, else what broke it.
"""

import contextlib
import resource
import signal
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from dvax.errors import InputError

SECONDS = 1.0
"""Processor time of one input."""
MEBIBYTES = 200.0
"""Memory that one input may add at its peak."""
_GIVE_UP = 4.0
"""Processor time after which a reading is interrupted."""
_ADDRESS_SPACE = 8 * 2**30
"""Address space that one input may add: a larger request fails and does not fill the machine."""
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Endless(BaseException):
    """A reading that took `_GIVE_UP` seconds. It is no `Exception`, so that nothing handles it."""


def examine(
    read: Callable[[], Any], size: Callable[[Any], int] = lambda value: 0
) -> tuple[str, Any]:
    """Return ("read", its value), ("refused", the error), or ("broken", a sentence with the reason).

    A value that was read has the `size`, a number of unknowns, that its input asks for: a model of
    finite elements is assembled as it is read. Each unknown adds half a millisecond and 20 kB.

    A reading that exceeds the time is repeated: programs that JAX compiles for a new shape are compiled
    once, so the second reading measures the reading alone.
    """
    verdict, value, seconds, mebibytes = _measured(read)
    if verdict != "broken" and (seconds > SECONDS or mebibytes > MEBIBYTES):
        verdict, value, seconds, mebibytes = _measured(read)
    if verdict == "broken":
        return verdict, value
    unknowns = size(value) if verdict == "read" else 0
    if seconds > SECONDS + 5e-4 * unknowns:
        return "broken", f"{seconds:.2f} s of processor time"
    if mebibytes > MEBIBYTES + 0.02 * unknowns:
        return "broken", f"{mebibytes:.0f} MiB of memory"
    if verdict == "refused":
        for problem in value.problems:
            if not (problem.place and problem.given and problem.rule and problem.fix):
                return "broken", f"a problem with an empty part: {problem!r}"
        if not value.problems:
            return "broken", "an InputError without a problem"
        if len(str(value)) > 100_000:
            return "broken", f"a message of {len(str(value))} characters"
        try:
            str(value).encode()
        except UnicodeEncodeError as error:
            return "broken", f"a message that cannot be printed: {error}"
    return verdict, value


def _measured(read: Callable[[], Any]) -> tuple[str, Any, float, float]:
    before = _resident("VmRSS", reset=True)
    started = time.process_time()
    verdict: str
    value: Any
    try:
        with _alarm(), _limited_memory(), warnings.catch_warnings():
            warnings.simplefilter("error")
            verdict, value = "read", read()
    except InputError as error:
        verdict, value = "refused", error
    except Endless:
        verdict, value = "broken", f"more than {_GIVE_UP:g} s of processor time"
    except (Exception, SystemExit) as error:  # noqa: BLE001  (any other exception breaks the promise)
        last = traceback.extract_tb(error.__traceback__)[-3:]
        at = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(last))
        verdict, value = "broken", f"{type(error).__name__}: {str(error)[:200]} ({at})"
    seconds = time.process_time() - started
    return verdict, value, seconds, _resident("VmHWM") - before


def _resident(name: str, reset: bool = False) -> float:
    """Return resident memory in MiB, that of now (VmRSS) or its peak (VmHWM) since it was reset; 0
    where the system does not say."""
    if not _CLEAR.exists():
        return 0.0
    if reset:
        _CLEAR.write_text("5")
    text = _STATUS.read_text()
    return int(text.split(f"{name}:")[1].split()[0]) / 1024


@contextlib.contextmanager
def _alarm() -> Iterator[None]:
    def stop(*_: Any) -> None:
        raise Endless

    before = signal.signal(signal.SIGVTALRM, stop)
    # Again and again: callbacks of the garbage collector swallow exceptions.
    signal.setitimer(signal.ITIMER_VIRTUAL, _GIVE_UP, 0.5)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


@contextlib.contextmanager
def _limited_memory() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    if not _STATUS.exists():
        yield
        return
    now = int(_STATUS.read_text().split("VmSize:")[1].split()[0]) * 1024
    resource.setrlimit(resource.RLIMIT_AS, (now + _ADDRESS_SPACE, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
