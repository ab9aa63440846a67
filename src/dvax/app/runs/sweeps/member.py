"""One member of a sweep: run it, store its results, write its record."""

import json
import os
import platform
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dvax.app.runs import driver
from dvax.app.runs.interrupt import exit_code
from dvax.app.runs.json_files import read_object
from dvax.app.runs.lock import locked
from dvax.app.runs.run import RunOutcome
from dvax.app.runs.sweeps.records import (
    FOLDER,
    folder_of,
    is_complete,
    read_record,
    write_record,
)
from dvax.app.runs.sweeps.store import NAME, Results, create, mark_member, write_member
from dvax.app.runs.sweeps.sweep import Sweep
from dvax.errors import InputError

_UNDER_WAY = ("running", "interrupted", "solved")


def run_member(sweep: Sweep, directory: Path, member: int) -> dict[str, Any]:
    """Run a member, unless it is complete, and store its results. Returns its record.

    Two processes never run the same member: the second one waits, and then finds it complete. A member
    whose process was killed goes on from its checkpoints. While there is no store, the record of a
    finished member has the status "solved", and its results stay in its folder.
    """
    digest = sweep.hash(member)
    with _alone(directory, member):
        record = read_record(directory, member)
        if record is not None and is_complete(record, digest):
            return record
        record = _solve(sweep, directory, member, digest)
        if record["status"] == "finished" and not (directory / NAME).is_dir():
            record["status"] = "solved"
            write_record(directory, record)
            return record
        return store_member(sweep, directory, record)


@contextmanager
def _alone(directory: Path, member: int) -> Iterator[None]:
    """In the block no other process runs this member."""
    (directory / FOLDER).mkdir(exist_ok=True)
    file = directory / FOLDER / f".{member:06d}.lock"
    with locked(file):
        yield
    file.unlink(missing_ok=True)


def _solve(sweep: Sweep, directory: Path, member: int, digest: str) -> dict[str, Any]:
    """Run a member in its own folder, from its checkpoints where there are some. Returns its record,
    which is not written yet."""
    folder, before = folder_of(directory, member), read_record(directory, member)
    started, clock = datetime.now(UTC), time.monotonic()
    about: dict[str, Any] = {
        "member": member, "hash": digest, "values": sweep.values(member),
        "started": started.isoformat(timespec="seconds"),
    }  # fmt: skip
    outcome: RunOutcome | None = None
    try:
        if before is not None and before.get("hash") == digest and before["status"] in _UNDER_WAY:
            outcome = _finished(folder) or _resumed(sweep, member, folder)
        if outcome is None:
            shutil.rmtree(folder, ignore_errors=True)
            write_record(directory, {**about, "status": "running"})
            outcome = driver.run(sweep.config(member), folder)
        about |= {
            "status": outcome.status, "exit_code": outcome.exit_code, "reason": outcome.stop_reason,
        }  # fmt: skip
    except InputError as error:
        about |= {"status": "failed", "exit_code": 2, "reason": str(error)}
    except KeyboardInterrupt as stop:
        about |= {"status": "interrupted", "exit_code": exit_code(stop), "reason": "Interrupted."}
    return {
        **about,
        "seconds": round(time.monotonic() - clock, 3),
        **_from_manifest(folder),
        "bounds": _bounds(folder),
        "host": platform.node(),
        "process": os.getpid(),
    }


def create_store(sweep: Sweep, directory: Path, member: int) -> None:
    """Write the schema of the store, that of the results of this member."""
    title = sweep.table.title or sweep.source.stem
    kept = sweep.table.output.variables
    results = _results(directory, member)
    create(directory, sweep.parameters, results, kept, {"title": title})


def store_member(sweep: Sweep, directory: Path, record: dict[str, Any]) -> dict[str, Any]:
    """Store the results of a member, write its record, and remove its folder where that is wanted."""
    member, folder = record["member"], folder_of(directory, record["member"])
    if record["status"] in ("finished", "solved"):
        record["status"] = "finished"
        record["unfit"] = write_member(
            directory, member, _results(directory, member), sweep.table.output.variables,
            int(record.get("steps") or 0),
        )  # fmt: skip
    elif (directory / NAME).is_dir():
        mark_member(directory, member, record["status"])
    write_record(directory, record)
    keep = sweep.table.output.runs
    whole = record["status"] == "finished" and not record.get("unfit")
    # Of an interrupted run its checkpoints are needed.
    if record["status"] != "interrupted" and (keep == "none" or (keep == "failed" and whole)):
        shutil.rmtree(folder, ignore_errors=True)
    return record


def _results(directory: Path, member: int) -> Results:
    folder = folder_of(directory, member)
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return Results(folder, {name: e for name, e in summary.items() if name != "status"})


def _finished(folder: Path) -> RunOutcome | None:
    """Return the outcome of a run that had ended before its record was written."""
    manifest = read_object(folder / "manifest.json")
    if manifest.get("status") != "finished" or not (folder / "summary.json").is_file():
        return None
    return RunOutcome("finished", 0, str(manifest["stop_reason"]), folder, {}, True)


def _resumed(sweep: Sweep, member: int, folder: Path) -> RunOutcome | None:
    """Return the outcome of a run that goes on; None where its checkpoints do not fit."""
    try:
        return driver.resume(sweep.config(member), folder)
    except InputError:
        return None  # then the member starts again, and reports what is wrong with its input


def _bounds(folder: Path) -> dict[str, str]:
    """Return how much is known of each bound in the summary of a run."""
    summary = read_object(folder / "summary.json")
    return {name: entry["bound"] for name, entry in summary.items() if "bound" in entry}


def _from_manifest(folder: Path) -> dict[str, Any]:
    manifest = read_object(folder / "manifest.json")
    names = ("steps", "method", "compile_seconds", "dvax", "packages", "precision", "device")
    return {name: manifest[name] for name in names if name in manifest}
