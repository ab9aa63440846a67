"""`dvax check CONFIG.toml`: what a run would be, without running it or writing anything."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dvax._figure_text import NOT_FINITE
from dvax.app.cli.console import complain, remark, say, table
from dvax.app.cli.constants import constant_rows
from dvax.app.cli.failure import OUT_OF_CLASS, reported
from dvax.app.cli.load import load
from dvax.app.cli.options import AllowOutside, ConfigFile, Debug
from dvax.app.cli.sizes import sizes
from dvax.app.cli.verdicts import outside_the_class, verdicts

if TYPE_CHECKING:
    from dvax.app.runs.applications.config import ModelConfig
    from dvax.theory import Assumption


def check(
    config: ConfigFile,
    strict: Annotated[
        bool,
        typer.Option("--strict", help="Exit with 4 where the system is outside the class."),
    ] = False,
    allow_outside: AllowOutside = False,
    debug: Debug = False,
) -> None:
    """Check CONFIG.toml and its data: constants, assumptions, sizes. Nothing is written."""
    with reported(debug):
        from dvax.app.runs.interrupt import interruptible

        loaded = interruptible(lambda: load(config, allow_outside))
        from dvax.app.runs.applications.config import ModelConfig
        from dvax.app.runs.config import build_contact
        from dvax.app.runs.contact_model import assumptions

        if isinstance(loaded, ModelConfig):
            _check_model(loaded, strict)
            return
        inputs = interruptible(lambda: build_contact(loaded))
        rows = interruptible(lambda: constant_rows(loaded))
        say(f"{loaded.source}: no problem in the configuration and its data", "bold")
        say("")
        _say_constants(rows)
        say("")
        known = interruptible(lambda: assumptions(loaded, inputs))
        _say_assumptions(known)
        say("")
        table(("statement", "verdict", "because"), verdicts(rows))
        say("")
        table(("size", "value", "remark"), interruptible(lambda: sizes(loaded, inputs)))
        for notice in inputs.notices:
            remark(f"note: {notice}")
        broken = _complain_of_broken(known)
        outside = outside_the_class(rows)
        for row in outside:
            complain(
                f"error: outside the class of the theory: {row['name']} = {row['value']:.6g}, "
                f"{row['status']} ({row['label']}). Every statement and bound rests on it."
            )
        if (outside or broken) and strict:
            raise typer.Exit(OUT_OF_CLASS)


def _check_model(config: "ModelConfig", strict: bool) -> None:
    """The same for an application."""
    from dvax.app.runs.applications.driver import constant_rows as rows_of
    from dvax.app.runs.interrupt import interruptible

    application = config.application
    constants, known, sizes, notes = interruptible(lambda: application.known(config.model))
    data = interruptible(config.fingerprints)
    say(f"{config.source}: no problem in the configuration and its data", "bold")
    say(f"class: {application.fit(config.model)}")
    if constants is not None:
        say("")
        _say_constants(rows_of(constants))
    if known:
        say("")
        _say_assumptions(known)
    say("")
    files = [("data", f.name, f"sha256 {f.sha256[:16]}…") for f in data]
    table(("size", "value", "remark"), [*sizes, *files])
    for note in notes:
        remark(f"note: {note}")
    if _complain_of_broken(known) and strict:
        raise typer.Exit(OUT_OF_CLASS)


def _say_assumptions(known: "Sequence[Assumption]") -> None:
    table(
        ("assumption", "status", "what it says", "how it is known"),
        [(row.label, row.status, row.statement, row.why) for row in known],
    )


def _complain_of_broken(known: "Sequence[Assumption]") -> bool:
    """Say which needed assumptions are refuted, and whether any is."""
    broken = [row for row in known if row.is_required and row.status == "refuted"]
    for row in broken:
        complain(f"error: {row.label} does not hold ({row.statement}): {row.why}")
    return bool(broken)


def _say_constants(rows: Sequence[Mapping[str, Any]]) -> None:
    shown = []
    for row in rows:
        value = row["value"]
        number = NOT_FINITE.get(f"{value:g}", f"{value:.6g}")
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
