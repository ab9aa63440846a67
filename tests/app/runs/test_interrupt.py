"""Signals are recorded at any time, raised while the main thread waits, and never during a write."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import dvax
from dvax.app.runs.interrupt import Terminated, Work, interruptible, patience, terminable, writing

BOTH = pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)]
)


def send(number: int) -> None:
    os.kill(os.getpid(), number)


@pytest.fixture(autouse=True)
def from_a_terminal() -> Iterator[None]:
    """Where the tests run in the background of a shell, Ctrl-C is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@BOTH
def test_signal_ends_a_wait(number: int, kind: type[KeyboardInterrupt]) -> None:
    with terminable():
        with pytest.raises(KeyboardInterrupt) as caught:
            interruptible(lambda: (send(number), threading.Event().wait()))
        assert caught.type is kind and patience() < 2.0


@BOTH
def test_signal_is_not_swallowed_by_broad_except_clauses(
    number: int, kind: type[KeyboardInterrupt]
) -> None:
    survived = False
    with terminable():
        try:
            send(number)
            time.sleep(0.05)
        except BaseException:  # noqa: BLE001 (as C code does in a callback)
            survived = True
        with pytest.raises(kind):
            interruptible(lambda: 1)
    assert not survived


@BOTH
def test_signal_does_not_interrupt_a_write(number: int, kind: type[KeyboardInterrupt]) -> None:
    written = []
    with pytest.raises(kind), terminable():
        with writing():
            send(number)
            written.append("whole")
        written.append("and after")
    assert written == ["whole", "and after"]


def test_second_signal_interrupts_again() -> None:
    with terminable():
        for number in (signal.SIGTERM, signal.SIGINT):
            send(number)
            with pytest.raises(KeyboardInterrupt):
                interruptible(lambda: 1)
        assert interruptible(lambda: 7) == 7


def test_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    with terminable():
        send(signal.SIGINT)
        assert interruptible(lambda: 7) == 7
    signal.signal(signal.SIGINT, before)


def test_nested_terminable_is_handled_by_the_outer_one() -> None:
    with pytest.raises(Terminated), terminable():
        with terminable():
            send(signal.SIGTERM)
        raise_here = True
        assert raise_here and interruptible(lambda: 1)


def test_work_result_with_timeout_leaves_the_work_running() -> None:
    release = threading.Event()
    work = Work(lambda: release.wait() and 7)
    with pytest.raises(TimeoutError):
        work.result(0.05)
    release.set()
    assert work.result() == 7 and patience() == float("inf")


HELD = """
import signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)
import dvax.app.cli.check
from dvax.app.cli import main

def held(error):  # in the main thread: a lock that is never released, as third-party code may take
    lock = threading.Lock()
    lock.acquire()
    print("held", file=sys.stderr, flush=True)
    lock.acquire()

import dvax.app.cli.failure
dvax.app.cli.failure.print_problems = held
sys.argv[1:] = ["check", "no such file.toml"]
main()
"""


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGTERM])
def test_blocked_main_thread_is_terminated(number: signal.Signals) -> None:
    run = subprocess.Popen(
        [sys.executable, "-c", HELD], stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(Path(dvax.__file__).parents[1])},
    )  # fmt: skip
    assert run.stderr is not None and any(line == "held\n" for line in run.stderr)
    run.send_signal(number)
    _, said = run.communicate(timeout=100)  # without the signal it would never end
    assert run.returncode == 128 + number and "Traceback" not in said
