"""`dvax check CONFIG.toml`: what a run would be, without running it or writing anything."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dvax.cli.failure import OUT_OF_CLASS, reported
from dvax.cli.options import ConfigFile, Debug
from dvax.cli.precision import enable_double
from dvax.cli.sizes import sizes
from dvax.cli.talk import complain, remark, say, table

if TYPE_CHECKING:
    from dvax.runs.config import Config


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

        loaded = load_config(config)
        inputs = build_contact(loaded)
        rows = constant_rows(loaded)
        say(f"{loaded.source}: no problem in the configuration and its data", "bold")
        say("")
        _say_constants(rows)
        say("")
        table(("size", "value", "remark"), sizes(loaded, inputs))
        for notice in inputs.notices:
            remark(f"note: {notice}")
        refuted = [row for row in rows if row["status"] == "refuted"]
        for row in refuted:
            complain(
                f"error: {row['symbol']} = {row['value']} ({row['label']}): {row['meaning']}. "
                "The theory does not cover this system."
            )
        if refuted and strict:
            raise typer.Exit(OUT_OF_CLASS)


def constant_rows(config: "Config") -> Sequence[Mapping[str, Any]]:
    """The constants of the theory with their labels, as a run writes them into its trajectory."""
    enable_double()
    from dvax.runs.constants import constant_rows as rows_of

    return rows_of(config)


def _say_constants(rows: Sequence[Mapping[str, Any]]) -> None:
    shown = []
    for row in rows:
        value = row["value"]
        number = f"{value:.6g}" if isinstance(value, int | float) else str(value)
        shown.append(
            (
                str(row["symbol"]),
                f"{number} {row['unit']}".strip(),
                str(row["status"]),
                str(row["label"]),
                str(row["meaning"]),
            )
        )
    table(("constant", "value", "status", "paper label", "meaning"), shown)
