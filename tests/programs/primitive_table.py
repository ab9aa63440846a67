"""The table of docs/programs.md: which domain has a rule for which operation.

    python -m tests.programs.primitive_table

writes the table into the page.
"""

from pathlib import Path

from dvax.programs import DOMAINS

PAGE = Path(__file__).parents[2] / "docs" / "programs.md"
BEGIN, END = "<!-- table: begin -->\n", "<!-- table: end -->\n"


def table() -> str:
    """One row per operation, one column per domain."""
    names = sorted({name for rules in DOMAINS.values() for name in rules})
    rows = [["operation", *DOMAINS], ["---"] * (len(DOMAINS) + 1)]
    rows += [[f"`{n}`", *("✓" if n in rules else "" for rules in DOMAINS.values())] for n in names]
    return "".join("| " + " | ".join(row) + " |\n" for row in rows)


def parts() -> tuple[str, str, str]:
    """The page before the table, the table, and the page after it."""
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    found, after = rest.split(END)
    return before, found, after


if __name__ == "__main__":
    before, _, after = parts()
    PAGE.write_text(before + BEGIN + table() + END + after, encoding="utf-8")
