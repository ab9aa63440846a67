"""Sections as aligned plain text."""

import textwrap
import unicodedata
from collections.abc import Sequence

from .clock import Spread
from .section import Comparison, Section, Table

_WIDTH = 100
_HEADER = ("case", "against", "dvax", "other", "ratio, median [range]", "error", "its error",
           "target", "met")  # fmt: skip


def duration(seconds: float | None) -> str:
    """Seconds in the unit that reads best, to three digits."""
    if seconds is None:
        return "-"
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


def as_text(section: Section) -> str:
    """Title, what is compared, tables, notes."""
    parts = [section.title, "-" * len(section.title), _wrap(section.fair)]
    if section.skipped is not None:
        parts.append(_wrap(f"Skipped: {section.skipped}"))
    if section.comparisons:
        parts += ["", _aligned(_HEADER, [_cells(row) for row in section.comparisons])]
    for table in section.tables:
        parts += ["", table.title, _table(table)]
    if section.notes:
        parts += ["", *(_wrap(f"- {note}", "  ") for note in section.notes)]
    return "\n".join(parts)


def verdicts(sections: Sequence[Section]) -> str:
    """Every target of a run, with what was reached."""
    rows = [
        (
            section.title.partition(":")[0],
            row.case,
            row.versus,
            str(row.target),
            f"{row.target.reached:.3g}{row.target.unit}",
            _met(row),
        )
        for section in sections
        for row in section.comparisons
        if row.target is not None
    ]
    if not rows:
        return "No target belongs to these cases."
    return _aligned(("", "case", "against", "target", "reached", "met"), rows)


def _cells(row: Comparison) -> tuple[str, ...]:
    return (
        row.case,
        row.versus,
        duration(row.dvax),
        duration(row.other),
        "-" if row.ratio is None else f"{row.direction} {_range(row.ratio)}",
        _error(row.error),
        _error(row.error_other),
        "-" if row.target is None else str(row.target),
        _met(row),
    )


def _met(row: Comparison) -> str:
    if row.target is None:
        return "-"
    return "yes" if row.target.met else "NO"


def _range(ratio: Spread) -> str:
    return f"{ratio.middle:.3g} [{ratio.low:.3g}, {ratio.high:.3g}]"


def _error(error: float | None) -> str:
    return "-" if error is None else f"{error:.1e}"


def _table(table: Table) -> str:
    return _aligned(table.header, table.rows)


def _aligned(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    every = [header, *rows]
    widths = [max(_columns(row[i]) for row in every) for i in range(len(header))]
    lines = ["  ".join(_pad(cell, w) for cell, w in zip(row, widths)).rstrip() for row in every]
    return "\n".join([lines[0], "  ".join("-" * w for w in widths), *lines[1:]])


def _pad(cell: str, width: int) -> str:
    return cell + " " * (width - _columns(cell))


def _columns(text: str) -> int:
    """Columns on a terminal: a combining mark takes none."""
    return sum(not unicodedata.combining(character) for character in text)


def _wrap(text: str, indent: str = "") -> str:
    return textwrap.fill(text, _WIDTH, subsequent_indent=indent, break_on_hyphens=False)
