"""The record of a member: a small JSON file that says how its run ended.

    members/000012.json    one a member, replaced as a whole
    members.jsonl          all of them, one a line, in the order of the members

A record with the status "finished" and the hash of the member's configuration is the commit marker of
its results: it is written after them.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dvax.app.runs.json_files import json_ready, read_object
from dvax.app.runs.rundir import write_json, write_whole

MANIFEST, KIND = "manifest.json", "sweep"
FOLDER, LINES = "members", "members.jsonl"


def folder_of(directory: Path, member: int) -> Path:
    """Return the run folder of a member."""
    return directory / FOLDER / f"{member:06d}"


def write_record(directory: Path, record: Mapping[str, Any]) -> None:
    """Write the record of a member."""
    (directory / FOLDER).mkdir(exist_ok=True)
    write_json(directory / FOLDER / f"{record['member']:06d}.json", record)


def read_record(directory: Path, member: int) -> dict[str, Any] | None:
    """Return the record of a member; None where there is none, or a damaged one."""
    record = read_object(directory / FOLDER / f"{member:06d}.json")
    return record if record.get("member") == member else None


def is_complete(record: Mapping[str, Any] | None, hash: str) -> bool:
    """Return whether a member is finished with this hash."""
    return record is not None and record.get("status") == "finished" and record["hash"] == hash


def records(directory: Path, count: int) -> Iterator[dict[str, Any]]:
    """The records of the first `count` members; one that has not run is "missing"."""
    for member in range(count):
        yield read_record(directory, member) or {"member": member, "status": "missing"}


def write_lines(directory: Path, count: int) -> None:
    """Write all records into one file."""
    lines = (
        json.dumps(json_ready(record), ensure_ascii=False) for record in records(directory, count)
    )
    write_whole(directory / LINES, "".join(f"{line}\n" for line in lines).encode())


def is_sweep(directory: Path) -> bool:
    """Return whether a folder holds a sweep."""
    return read_object(directory / MANIFEST).get("kind") == KIND
