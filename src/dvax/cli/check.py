"""`dvax check CONFIG.toml`: what a run would be, without running it or writing anything."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from dvax.cli.constants import constant_rows
from dvax.cli.failure import OUT_OF_CLASS, reported
from dvax.cli.options import ConfigFile, Debug
from dvax.cli.precision import enable_double
from dvax.cli.sizes import sizes
from dvax.cli.talk import complain, remark, say, table
from dvax.cli.verdicts import outside_the_class, verdicts


def check(
    config: ConfigFile,
    strict: Annotated[
        bool,
        typer.Option("--strict", help="Exit with 4 where the system is outside the class."),
    ] = False,
    debug: Debug = False,
) -> None:
    """Check CONFIG.toml and its data: constants, assumptions, sizes. Nothing is written."""
    with reported(debug):
        from dvax.runs.config import build_contact, load_config
        from dvax.runs.contact_model import assumptions

        loaded = load_config(config)
        inputs = build_contact(loaded)
        enable_double()
        rows = constant_rows(loaded)
        say(f"{loaded.source}: no problem in the configuration and its data", "bold")
        say("")
        _say_constants(rows)
        say("")
        known = assumptions(loaded, inputs)
        table(
            ("assumption", "status", "what it says", "how it is known"),
            [(row.label, row.status, row.statement, row.why) for row in known],
        )
        say("")
        table(("statement", "verdict", "because"), verdicts(rows))
        say("")
        table(("size", "value", "remark"), sizes(loaded, inputs))
        for notice in inputs.notices:
            remark(f"note: {notice}")
        broken = [row for row in known if row.needed and row.status == "refuted"]
        for row in broken:
            complain(f"error: {row.label} does not hold ({row.statement}): {row.why}")
        outside = outside_the_class(rows)
        for row in outside:
            complain(
                f"error: outside the class of the theory: {row['name']} = {row['value']:.6g}, "
                f"{row['status']} ({row['label']}). Every statement and bound rests on it."
            )
        if (outside or broken) and strict:
            raise typer.Exit(OUT_OF_CLASS)


def _say_constants(rows: Sequence[Mapping[str, Any]]) -> None:
    shown = []
    for row in rows:
        value = row["value"]
        number = f"{value:.6g}" if isinstance(value, int | float) else str(value)
        shown.append(
            (
                str(row["symbol"]),
                number if row["unit"] in ("", "1") else f"{number} {row['unit']}",
                str(row["status"]),
                str(row["label"]),
                str(row["meaning"]),
            )
        )
    table(("constant", "value", "status", "paper label", "meaning"), shown)
