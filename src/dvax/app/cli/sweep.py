"""`dvax sweep SWEEP.toml -o DIR`: many runs of one configuration."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shlex import quote
from typing import Annotated, Any

import typer

from dvax.app.cli.console import console, print_remark, print_table
from dvax.app.cli.failure import reported
from dvax.app.cli.options import AllowCode, AllowOutside, Debug, Quiet
from dvax.errors import input_error


def sweep(
    file: Annotated[
        Path, typer.Argument(metavar="SWEEP.toml", help="A configuration, and what varies in it.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="The folder for the results.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Run the members that have no complete results in DIR.")
    ] = False,
    member: Annotated[
        int | None, typer.Option("--member", help="Run this member alone: for arrays of jobs.")
    ] = None,
    create: Annotated[
        bool,
        typer.Option(
            "--create", help="Run until one member has finished, then --member can follow."
        ),
    ] = False,
    show: Annotated[
        bool, typer.Option("--list", help="Print the members, and run nothing.")
    ] = False,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Processes, by default one a core.")
    ] = None,
    threads: Annotated[int, typer.Option("--threads", min=1, help="Threads of each process.")] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="A Dask scheduler that is there."),
    ] = None,
    quiet: Quiet = False,
    allow_outside: AllowOutside = False,
    allow_code: AllowCode = False,
    debug: Debug = False,
) -> None:
    """Run a configuration for many values of its keys; one table of all results goes into DIR."""
    with reported(debug, out):
        # Before JAX starts, so that one member alone has the arithmetic of a worker.
        os.environ.setdefault("NPROC", str(threads))
        from dvax.app.runs.interrupt import interruptible

        checked = interruptible(lambda: _read(file, allow_outside, allow_code))
        if show:
            _list(checked)
            return
        if out is None:
            raise input_error(
                "--out", "nothing", "results are written into a folder", "Write -o DIR"
            )
        if member is not None:
            _run_one(checked, out, member)
            return
        from dvax.app.runs.sweeps.driver import run_sweep
        from dvax.app.runs.sweeps.workers import default_workers

        with _progress(quiet) as tell:
            outcome = run_sweep(
                checked, out, resume=resume, create_only=create, threads=threads, scheduler=scheduler,
                workers=workers or default_workers(threads), tell=tell,
            )  # fmt: skip
        _conclude(checked, outcome, quiet)


def _read(file: Path, allow_outside: bool, allow_code: bool) -> Any:
    from dvax.app.runs.compilation_cache import enable_compilation_cache, enable_double

    enable_double()
    enable_compilation_cache()
    from dvax.app.runs.sweeps.sweep import read_sweep

    return read_sweep(file, allow_outside=allow_outside, allow_code=allow_code)


def _list(sweep: Any) -> None:
    """Print a row a member: its number, and its values."""
    keys = [p.key for p in sweep.parameters]
    rows = [
        (str(k), *(str(value) for value in sweep.values(k).values())) for k in range(sweep.count)
    ]
    print_table(("member", *keys), rows)


def _run_one(sweep: Any, out: Path, member: int) -> None:
    """Run one member in this process, and exit with its code."""
    from dvax.app.runs.sweeps import store
    from dvax.app.runs.sweeps.member import run_member

    if not 0 <= member < sweep.count:
        raise input_error(
            "--member", str(member), f"the members are 0 to {sweep.count - 1}", "Give one of these"
        )
    if not (out / store.NAME).is_dir():
        raise input_error(
            f"--member {member}", f"{out} without {store.NAME}",
            "members are written into a store that one process has made",
            f"First run dvax sweep {quote(str(sweep.source))} -o {quote(str(out))} --create",
        )  # fmt: skip
    store.check_fit(out, sweep.parameters)
    record = run_member(sweep, out, member)
    print_remark(f"member {member}: {record['status']}: {record['reason']}")
    if record["exit_code"]:
        raise typer.Exit(record["exit_code"])


@contextmanager
def _progress(quiet: bool) -> Iterator[Any]:
    """A listener for the events of a sweep: a bar on a terminal, lines in a pipe."""
    if quiet:
        yield lambda event: None
    elif not console(stderr=True).is_terminal:
        yield _Lines()
    else:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
            TextColumn("{task.fields[failed]}"), TimeElapsedColumn(), TextColumn("left"),
            TimeRemainingColumn(),
        )  # fmt: skip
        with Progress(*columns, console=console(stderr=True)) as bar:
            task, failed = bar.add_task("members", total=None, failed=""), 0

            def listen(event: Any) -> None:
                nonlocal failed
                if event["event"] == "started":
                    bar.update(task, total=event["members"], completed=event["complete"])
                elif event["event"] == "member":
                    bar.advance(task)
                    if event["status"] == "failed":
                        failed += 1
                        bar.update(task, failed=f"{failed} failed")
                        text = f"member {event['member']} failed: {event['reason']}"
                        bar.console.print(text, markup=False, style="yellow")

            yield listen


class _Lines:
    """A line for each tenth of the members, and one for each failure."""

    def __init__(self) -> None:
        self.count = self.done = self.tenth = 0
        self.began = time.monotonic()

    def __call__(self, event: Any) -> None:
        if event["event"] == "started":
            self.count, self.done = event["members"], event["complete"]
            self.tenth = 10 * self.done // self.count
            found = f", {self.done} complete" if self.done else ""
            print_remark(f"{self.count} members{found}")
            self.first = self.done
        elif event["event"] == "member":
            self.done += 1
            if event["status"] == "failed":
                print_remark(f"member {event['member']} failed: {event['reason']}")
            tenth = 10 * self.done // self.count
            if tenth > self.tenth:
                self.tenth = tenth
                each = (time.monotonic() - self.began) / (self.done - self.first)
                left = each * (self.count - self.done)
                print_remark(f"{self.done} of {self.count} members, {left:.0f} s left")


def _conclude(sweep: Any, outcome: Any, quiet: bool) -> None:
    """Make the report of a sweep, print how it ended, and exit with its code."""
    from dvax.app.runs.interrupt import interruptible

    said = ", ".join(f"{count} {status}" for status, count in outcome.counts.items())
    if sweep.table.output.report:
        from dvax.app.plots.report import build_report

        page = interruptible(lambda: build_report(outcome.directory))
        if not quiet:
            print_remark(f"report: {page}")
    if outcome.exit_code or not quiet:
        print_remark(f"{said}; the results are in {outcome.directory}")
    if outcome.exit_code:
        flag = " --allow-code" if sweep.allow_code else ""
        command = f"dvax sweep {quote(str(sweep.source))} -o {quote(str(outcome.directory))}"
        print_remark(f"to run what is missing: {command} --resume{flag}")
    raise typer.Exit(outcome.exit_code)
