"""A sweep whose processes are killed: in the end it has the bits of one that nothing disturbed."""

import os
import random
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray

from dvax.app.runs.sweeps.store import NAME

from .decay import written

pytestmark = pytest.mark.thorough

SWEEP = """
[grid]
"model.parameters.rate" = { from = 0.5, to = 4.0, count = 5 }
"model.parameters.push" = [0.0, 1.0]
"""
# A run of some seconds, so that kills meet it: a short step, and checkpoints of each piece.
CONFIG = (
    '[model]\npython = "decay.py:build"\nframes = 200\nmethod = "ETD2RK"\ndt = 5e-7\n'
    "[output]\ncheckpoint_seconds = 0\n"
)
MEMBERS = 10


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return written(tmp_path_factory.mktemp("decay"), SWEEP, CONFIG)


def started(file, out, *more):
    program = str(Path(sys.executable).with_name("dvax"))
    command = [program, "sweep", str(file), "-o", str(out), "--allow-code"]
    return subprocess.Popen(
        [*command, *more], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True,
    )  # fmt: skip


def ended(process):
    said, _ = process.communicate(timeout=600)
    return process.returncode, said


@pytest.fixture(scope="module")
def quiet(file, tmp_path_factory):
    out = tmp_path_factory.mktemp("quiet") / "out"
    code, said = ended(started(file, out, "--workers", "1"))
    assert code == 0, said
    return results(out)


def results(out):
    with xarray.open_zarr(out / NAME) as data:
        return {str(name): np.asarray(array) for name, array in data.variables.items()}


def assert_same(out, quiet):
    found = results(out)
    assert found.keys() == quiet.keys()
    for name in quiet:
        np.testing.assert_array_equal(found[name], quiet[name], err_msg=name)
    assert (found["status"] == 1).all()


def descendants(number):
    """The processes below a process."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                about = (folder / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            if int(about[1]) == number:
                found += [int(folder.name), *descendants(int(folder.name))]
    return found


def workers(number):
    """The processes below a sweep that run members."""
    found = []
    for child in descendants(number):
        try:
            line = (Path("/proc") / str(child) / "cmdline").read_bytes().decode()
        except OSError:
            continue
        if "spawn_main" in line:
            found.append(child)
    return found


def test_killed_workers_lose_no_member(file, quiet, tmp_path):
    out, chance, killed = tmp_path / "out", random.Random(1), 0
    process = started(file, out, "--workers", "2")
    while process.poll() is None:
        time.sleep(chance.uniform(4.0, 12.0))
        if process.poll() is None and (there := workers(process.pid)) and killed < 6:
            os.kill(chance.choice(there), signal.SIGKILL)
            killed += 1
    code, said = ended(process)
    assert code == 0 and killed >= 2, said
    assert_same(out, quiet)


@pytest.mark.parametrize(
    ("number", "send"),
    [
        (signal.SIGKILL, os.kill), (signal.SIGTERM, os.kill), (signal.SIGINT, os.kill),
        # Ctrl-C in a terminal.
        (signal.SIGINT, os.killpg),
    ],
)  # fmt: skip
def test_sweep_that_ends_early_goes_on(file, quiet, tmp_path, number, send):
    out, chance, ends = tmp_path / "out", random.Random(int(number)), []
    for attempt in range(40):
        process = started(file, out, *(["--resume"] if out.exists() else []), "--workers", "2")
        try:
            # Later ones live longer, so that the sweep ends.
            code = process.wait(timeout=chance.uniform(6.0, 14.0) + 2 * attempt)
        except subprocess.TimeoutExpired:
            send(process.pid, number)
            code = process.wait(timeout=30)
        said = process.stdout.read()
        process.stdout.close()
        ends.append(code)
        if code == 0:
            break
        if not (out / "manifest.json").exists():
            assert not out.exists() or not any(out.iterdir()) or number == signal.SIGKILL
        expected = {signal.SIGKILL: -9, signal.SIGTERM: 143, signal.SIGINT: 130}[number]
        # A signal to a process that ended its work and shuts down has its default effect.
        assert code == expected or (code == -number and "report: " in said), said
        assert "Traceback" not in said and "Warning" not in said, said
        if number != signal.SIGKILL and "complete" in said:
            is_whole = f"{MEMBERS} finished" in said
            assert is_whole or "to run what is missing: dvax sweep" in said, said
    assert ends[-1] == 0 and len(ends) > 1
    assert_same(out, quiet)


def test_killed_scheduler_is_reported_and_a_new_one_goes_on(file, quiet, tmp_path):
    out = tmp_path / "out"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"

    def cluster():
        where = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
        port = re.sub(r".*:", "", address)
        scheduler = subprocess.Popen(
            [*where, "--host", "127.0.0.1", "--port", port, "--no-dashboard"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        worker = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1",
             "--no-dashboard", "--local-directory", str(tmp_path)],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env={**os.environ, "NPROC": "1"},
        )  # fmt: skip
        return scheduler, worker

    scheduler, worker = cluster()
    process = started(file, out, "--scheduler", address)
    while len(list((out / "members").glob("*.json")) if out.exists() else []) < 4:
        time.sleep(0.5)
        assert process.poll() is None
    scheduler.kill()
    code, said = ended(process)
    worker.kill()
    assert code == 2 and "--resume" in said and "Traceback" not in said, said
    for each in (scheduler, worker):
        each.wait()
    scheduler, worker = cluster()
    code, said = ended(started(file, out, "--scheduler", address, "--resume"))
    for each in (scheduler, worker):
        each.kill()
        each.wait()
    assert code == 0, said
    assert_same(out, quiet)


def test_array_of_jobs_at_the_same_time_gives_the_bits_of_the_sweep(file, quiet, tmp_path):
    out = tmp_path / "out"
    assert ended(started(file, out, "--create"))[0] == 0
    waiting = [k for k in range(MEMBERS) for _ in range(2)]  # each job is submitted twice
    running: list[subprocess.Popen[str]] = []
    while waiting or running:
        while waiting and len(running) < 4:
            running.append(started(file, out, "--member", str(waiting.pop())))
        code, said = ended(running.pop(0))
        assert code == 0, said
    assert ended(started(file, out, "--resume"))[0] == 0
    assert_same(out, quiet)
