"""What the command line prints: results to standard output, all else to standard error.

On a terminal with colour and tables; in a pipe as plain lines, one fact a line, never wrapped.
"""

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from dvax.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console


def console(*, stderr: bool = False) -> "Console":
    """The console of standard output or error, as it is now (tests and pipes replace it)."""
    from rich.console import Console

    return Console(highlight=False, stderr=stderr)


_CONTROL = re.compile(
    "[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u202a-\\u202e\\u2066-\\u2069\\ud800-\\udfff]"
)


def visible(text: str) -> str:
    """Return a text with escapes in the place of characters that control a terminal, reverse the
    direction of writing, or cannot be encoded: names of files and keys may have them."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def print_line(text: str, style: str = "") -> None:
    """Print a line of results as given: no markup, no wrapping in a pipe."""
    console().print(visible(text), style=style or None, markup=False, soft_wrap=True)


def print_remark(text: str, style: str = "") -> None:
    """Print a line beside the results: progress, what was written where."""
    console(stderr=True).print(visible(text), style=style or None, markup=False, soft_wrap=True)


def print_error(text: str) -> None:
    """Print a line that says what went wrong."""
    print_remark(text, "bold red" if text.startswith("error") else "")


def print_problems(error: InputError, kept: str = "nothing was written") -> None:
    """Print every problem of an InputError: where, what was given, the rule, the fix; before them, what
    of the results is on disk."""
    count = len(error.problems)
    print_error(f"error: {count} problem{'s' * (count != 1)} in the input; {kept}")
    for number, problem in enumerate(error.problems, start=1):
        place = problem.place.replace("\n", "\\n")  # of a key or a file
        print_remark(f"{number}. {place}", "bold")
        print_remark(f"   given: {problem.given}")
        print_remark(f"   rule:  {problem.rule}")
        print_remark(f"   fix:   {problem.fix}")


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows of results: a table on a terminal, aligned columns in a pipe."""
    if console().is_terminal:
        from rich.box import SIMPLE_HEAD
        from rich.table import Table
        from rich.text import Text

        drawn = Table(box=SIMPLE_HEAD, pad_edge=False)
        for name in head:
            drawn.add_column(name, overflow="fold")
        for row in rows:
            drawn.add_row(*(Text(visible(cell)) for cell in row))
        console().print(drawn)
        return
    from rich.cells import cell_len, set_cell_size

    # Widths on the screen: the tilde of L̃ takes no room of its own.
    widths = [max(map(cell_len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        cells = [set_cell_size(cell, width) for cell, width in zip(row, widths, strict=True)]
        print_line("  ".join(cells).rstrip())
