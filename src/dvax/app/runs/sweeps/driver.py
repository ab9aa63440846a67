"""`sweep`: run the members that lack results, and leave one table of all."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dvax.app.runs.interrupt import exit_code, interruptible, terminable, writing
from dvax.app.runs.lock import NAME as LOCK
from dvax.app.runs.lock import lock
from dvax.app.runs.provenance import provenance
from dvax.app.runs.rundir import consolidate, process, write_json
from dvax.app.runs.sweeps import store
from dvax.app.runs.sweeps.member import create_store, store_member
from dvax.app.runs.sweeps.records import (
    KIND,
    MANIFEST,
    is_complete,
    is_sweep,
    read_record,
    records,
    write_lines,
)
from dvax.app.runs.sweeps.sweep import Sweep
from dvax.app.runs.sweeps.workers import cluster, results
from dvax.errors import Problems

Listener = Callable[[Mapping[str, Any]], None]


@dataclass(frozen=True)
class SweepOutcome:
    """How a sweep ended: the number of members by status. `exit_code`: 0 all finished, 3 some failed,
    130 interrupted, 143 asked to terminate."""

    directory: Path
    counts: Mapping[str, int]
    exit_code: int


def run_sweep(
    sweep: Sweep,
    out: Path,
    *,
    resume: bool = False,
    create_only: bool = False,
    workers: int = 1,
    threads: int = 1,
    scheduler: str | None = None,
    tell: Listener = lambda event: None,
) -> SweepOutcome:
    """Run the members of a sweep that have no complete results in `out`, on Dask workers: those of a
    `scheduler`, else `workers` new processes with so many `threads` each.

    With `create_only` members are run, in their order, until one has finished, so that the store is
    there for `run_member`. `tell` is called with dicts whose "event" is started, member or stopped.

    **Raises:** `dvax.InputError` if `out` cannot be written, or if no scheduler answers.
    """
    target_problems(out, resume=resume).raise_any()
    out.mkdir(parents=True, exist_ok=True)
    with terminable(), closing(lock(out)):
        has_store = (out / store.NAME).is_dir()
        if has_store:
            store.check_fit(out, sweep.parameters)
        todo = [
            k
            for k in range(sweep.count)
            if not (has_store and is_complete(read_record(out, k), sweep.hash(k)))
        ]
        manifest = _Manifest(sweep, out)
        manifest.write("running")
        tell({"event": "started", "members": sweep.count, "complete": sweep.count - len(todo)})
        code, collector = 0, _Collector(sweep, out, has_store)
        try:
            if todo and not (create_only and has_store):
                with cluster(scheduler, min(workers, len(todo)), threads) as client:
                    batches = [[k] for k in todo] if create_only else [todo]
                    for batch in batches:
                        ended = results(client, sweep, out, batch)
                        while (record := interruptible(_next(ended))) is not None:
                            tell({"event": "member", **collector.add(record)})
                        if create_only and collector.has_store:
                            break
        except KeyboardInterrupt as stop:
            code = exit_code(stop)
        with writing():
            write_lines(out, sweep.count)
            if collector.has_store:
                consolidate(out / store.NAME)
            counts = Counter(record["status"] for record in records(out, sweep.count))
            if code:
                counts["interrupted"] += counts.pop("running", 0)
            finished = create_only or counts["finished"] == sweep.count
            manifest.write("interrupted" if code else "finished", counts)
        tell({"event": "stopped", "counts": counts})
    return SweepOutcome(out, counts, code or (0 if finished else 3))


def _next(records: Iterator[dict[str, Any]]) -> Callable[[], dict[str, Any] | None]:
    return lambda: next(records, None)


class _Collector:
    """Takes the records of members as they end. The store has the schema of the first member, in their
    order, that finishes: until then the results of others wait in their folders."""

    def __init__(self, sweep: Sweep, out: Path, has_store: bool):
        self.sweep, self.out, self.has_store = sweep, out, has_store
        self.waiting: dict[int, dict[str, Any]] = {}
        self.failed: set[int] = set()

    def add(self, record: dict[str, Any]) -> dict[str, Any]:
        """Store what can be stored, and return the record."""
        if record["status"] == "solved":
            self.waiting[record["member"]] = record
        elif record["status"] != "finished":
            self.failed.add(record["member"])
        if not self.has_store:
            first = next((k for k in range(self.sweep.count) if k not in self.failed), None)
            if first not in self.waiting:
                return record
            create_store(self.sweep, self.out, first)
            self.has_store = True
        for each in self.waiting.values():
            store_member(self.sweep, self.out, each)
        # The worker could not, if there was no store then.
        for member in self.failed:
            store.mark_member(self.out, member, "failed")
        self.waiting.clear()
        self.failed.clear()
        return record


class _Manifest:
    """manifest.json: what is swept, by which versions, and how it ended."""

    def __init__(self, sweep: Sweep, out: Path):
        self.file, self.started = out / MANIFEST, _now()
        self.facts = {
            **provenance(),
            "kind": KIND,
            "title": sweep.table.title or sweep.source.stem,
            "sweep": str(sweep.source),
            "config": str(sweep.base),
            "members": sweep.count,
            "parameters": {p.key: p.unit for p in sweep.parameters},
        }

    def write(self, status: str, counts: Mapping[str, int] | None = None) -> None:
        finished = None if counts is None else _now()
        content = {
            **self.facts, **process(), "status": status, "started": self.started,
            "finished": finished, "counts": dict(counts or {}),
        }  # fmt: skip
        write_json(self.file, content)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def target_problems(out: Path, *, resume: bool) -> Problems:
    """Return the reasons not to write a sweep into `out`."""
    problems = Problems()
    if out.exists() and not out.is_dir():
        fix = "Give the name of a folder that does not exist yet."
        problems.add(str(out), "a file", "results are written into a folder", fix)
    elif resume and not is_sweep(out):
        problems.add(
            str(out), "no sweep", "a sweep that goes on has a folder with its manifest.json",
            "Leave out --resume, or give the folder of dvax sweep -o DIR",
        )  # fmt: skip
    elif not resume and out.exists() and any(file.name != LOCK for file in out.iterdir()):
        problems.add(
            str(out), "a folder that is not empty", "results are never written over others unasked",
            "Pass --resume to run what is missing in it, or give another folder",
        )  # fmt: skip
    return problems
