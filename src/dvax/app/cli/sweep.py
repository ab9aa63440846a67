"""`dvax sweep SWEEP.toml -o DIR`: many runs of one configuration."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from shlex import quote
from typing import Annotated, Any

import typer

from dvax.app.cli.console import print_line, print_remark, print_table
from dvax.app.cli.failure import reported
from dvax.app.cli.options import AllowCode, AllowOutside, Debug, Quiet
from dvax.app.cli.progress import Listener, progress
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
    check: Annotated[
        bool, typer.Option("--check", help="Check the input of all members, and run nothing.")
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
        if check:
            from dvax.app.runs.sweeps.validity import member_problems

            found = interruptible(lambda: member_problems(checked, range(checked.count)))
            found.raise_any()
            print_line(f"{file}: no problem in the input of {checked.count} members")
            return
        interruptible(lambda: _require_valid_member(checked))
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

        with progress(quiet=quiet) as listener:
            outcome = run_sweep(
                checked, out, resume=resume, create_only=create, threads=threads, scheduler=scheduler,
                workers=workers or default_workers(threads), tell=member_listener(listener),
            )  # fmt: skip
        _conclude(checked, outcome, quiet)


def _read(file: Path, allow_outside: bool, allow_code: bool) -> Any:
    from dvax.app.runs.compilation_cache import enable_compilation_cache, enable_double

    enable_double()
    enable_compilation_cache()
    from dvax.app.runs.sweeps.sweep import read_sweep

    return read_sweep(file, allow_outside=allow_outside, allow_code=allow_code)


def _require_valid_member(sweep: Any) -> None:
    from dvax.app.runs.sweeps.validity import require_valid_member

    require_valid_member(sweep)


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
    print_remark(f"{_who(record)}: {record['status']}: {record['reason']}")
    if record["exit_code"]:
        raise typer.Exit(record["exit_code"])


def _who(record: Mapping[str, Any]) -> str:
    """Return the number of a member and its values, by its record."""
    from dvax.app.runs.sweeps.sweep import values_text

    values = values_text(record.get("values", {}))
    return f"member {record['member']}" + (f" ({values})" if values else "")


def member_listener(listener: Listener) -> Callable[[Mapping[str, Any]], None]:
    """Return a listener for the events of a sweep that passes its members on as the progress of a run,
    and failures as warnings."""
    count = complete = done = 0

    def listen(event: Mapping[str, Any]) -> None:
        nonlocal count, complete, done
        if event["event"] == "started":
            count, complete = event["members"], event["complete"]
            listener({"event": "stage", "stage": f"{count} members, {complete} complete"})
        elif event["event"] == "member":
            done += 1
            if event["status"] == "failed":
                message = f"{_who(event)} failed: {event['reason']}"
                listener({"event": "warning", "message": message})
            # The share and the time left are those of the members of this call.
            where = f"{done} of {count - complete} {'missing ' if complete else ''}members"
            listener({"event": "progress", "t": done, "t_end": count - complete, "where": where})

    return listen


def _conclude(sweep: Any, outcome: Any, quiet: bool) -> None:
    """Make the report of a sweep, print how it ended, and exit with its code."""
    from dvax.app.runs.interrupt import interruptible

    said = ", ".join(f"{count} {status}" for status, count in outcome.counts.items())
    # Before the report, for which an interrupt may leave no time.
    if outcome.exit_code or not quiet:
        print_remark(f"{said}; the results are in {outcome.directory}")
    if outcome.exit_code:
        flag = " --allow-code" if sweep.allow_code else ""
        command = f"dvax sweep {quote(str(sweep.source))} -o {quote(str(outcome.directory))}"
        print_remark(f"to run what is missing: {command} --resume{flag}")
    if sweep.table.output.report:
        from dvax.app.plots.report import build_report

        page = interruptible(lambda: build_report(outcome.directory))
        if not quiet:
            print_remark(f"report: {page}")
    raise typer.Exit(outcome.exit_code)
