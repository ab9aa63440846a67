"""`dvax check CONFIG.toml`: what a run would be, without running it or writing anything."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from dvax._figure_text import NOT_FINITE
from dvax.app.cli.console import print_error, print_line, print_remark, print_table
from dvax.app.cli.failure import OUT_OF_CLASS, reported
from dvax.app.cli.load import load
from dvax.app.cli.options import AllowCode, AllowOutside, ConfigFile, Debug
from dvax.app.cli.overview import outside_the_class, overview


def check(
    config: ConfigFile,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Exit with 4 where the system is outside the class, and not just where K(t) is empty.",
        ),
    ] = False,
    allow_outside: AllowOutside = False,
    allow_code: AllowCode = False,
    debug: Debug = False,
) -> None:
    """Check CONFIG.toml and its data: constants, assumptions, sizes. Nothing is written."""
    with reported(debug):
        from dvax.app.runs.interrupt import interruptible

        loaded = interruptible(lambda: load(config, allow_outside, allow_code=allow_code))
        found = interruptible(lambda: overview(loaded))
        refuted = [
            row
            for row in found.assumptions
            if row.is_required and row.status == "refuted" and not row.holds_between_jumps
        ]
        # No run gets past a time at which K(t) is empty; other laws may have a solution all the same.
        impossible = any(row.label == "ass:operators (iii)" for row in refuted)
        if refuted and not impossible:
            words = (
                "the configuration and its data are valid, but an assumption does not hold (below)"
            )
            print_line(f"{loaded.source}: {words}", "bold")
        elif not impossible:
            print_line(f"{loaded.source}: no problem in the configuration and its data", "bold")
        if found.fit:
            print_line(f"class: {found.fit}")
        assumptions = [(row.label, row.status, row.statement, row.why) for row in found.assumptions]
        for head, rows in (
            (("constant", "value", "status", "paper label", "meaning"), _cells(found.constants)),
            (("assumption", "status", "what it says", "how it is known"), assumptions),
            (("statement", "verdict", "because"), found.verdicts),
            (("size", "value", "remark"), found.sizes),
        ):
            if rows:
                print_line("")
                print_table(head, rows)
        for note in found.notes:
            print_remark(f"note: {note}")
        outside = outside_the_class(found.constants)
        word = "error" if strict or impossible else "warning"
        for row in refuted:
            print_error(f"{word}: {row.label} does not hold ({row.statement}): {row.why}")
        for row in outside:
            print_error(
                f"{word}: outside the class of the theory: {row['name']} = {row['value']:.6g}, "
                f"{row['status']} ({row['label']}). Every statement and bound rests on it."
            )
        if impossible or (strict and (refuted or outside)):
            raise typer.Exit(OUT_OF_CLASS)


def _cells(constants: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    cells = []
    for row in constants:
        value = row["value"]
        number = NOT_FINITE.get(f"{value:g}", f"{value:.6g}")
        unit = "" if row["unit"] in ("", "1") else f" {row['unit']}"
        rest = (str(row[name]) for name in ("status", "label", "meaning"))
        cells.append((str(row["symbol"]), number + unit, *rest))
    return cells
