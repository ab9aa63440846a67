"""What the command line says: results to standard output, all else to standard error.

On a terminal with colour and tables; in a pipe as plain lines, one fact a line, never wrapped.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from dvax.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console


def results() -> "Console":
    """The console of standard output, as it is now (tests and pipes replace it)."""
    from rich.console import Console

    return Console(highlight=False)


def remarks() -> "Console":
    """The console of standard error."""
    from rich.console import Console

    return Console(highlight=False, stderr=True)


def say(text: str, style: str = "") -> None:
    """A line of results, exactly as given: no markup, no wrapping in a pipe."""
    _line(results(), text, style)


def remark(text: str, style: str = "") -> None:
    """A line beside the results: progress, what was written where."""
    _line(remarks(), text, style)


def complain(text: str) -> None:
    """A line that says what went wrong."""
    remark(text, "bold red" if text.startswith("error") else "")


def complain_of(error: InputError, kept: str = "nothing was written") -> None:
    """Every problem of an InputError: where, what was given, the rule, the fix; before them, what of
    the results is on disk."""
    count = len(error.problems)
    complain(f"error: {count} problem{'s' * (count != 1)} in the input; {kept}")
    for number, problem in enumerate(error.problems, start=1):
        remark(f"{number}. {problem.place}", "bold")
        remark(f"   given: {problem.given}")
        remark(f"   rule:  {problem.rule}")
        remark(f"   fix:   {problem.fix}")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Rows of results: a table on a terminal, aligned columns in a pipe."""
    console = results()
    if console.is_terminal:
        from rich.box import SIMPLE_HEAD
        from rich.table import Table
        from rich.text import Text

        drawn = Table(box=SIMPLE_HEAD, pad_edge=False)
        for name in head:
            drawn.add_column(name, overflow="fold")
        for row in rows:
            drawn.add_row(*map(Text, row))
        console.print(drawn)
        return
    from rich.cells import cell_len, set_cell_size

    # Widths on the screen: the tilde of L̃ takes no room of its own.
    widths = [max(map(cell_len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        cells = [set_cell_size(cell, width) for cell, width in zip(row, widths, strict=True)]
        say("  ".join(cells).rstrip())


def _line(console: "Console", text: str, style: str) -> None:
    console.print(text, style=style or None, markup=False, soft_wrap=True)
