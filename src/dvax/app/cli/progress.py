"""The progress of a run: a bar with the time left on a terminal, lines in a pipe.

The driver sends events, dicts with `event` one of compiled, progress, stage, warning, stopped. A model
that is solved in one piece has stages in the place of progress. An event of progress may have its text
as `where`: members of a sweep do not have steps. Compile time is shown apart: it occurs
once, and does not predict the time of the rest.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from dvax.app.cli.console import console, print_remark

Event = dict[str, Any]
Listener = Callable[[Event], None]

# In a pipe: one line for each tenth of the run, and at least one in this time.
LINES, SECONDS_BETWEEN = 10, 30.0


@contextmanager
def progress(*, quiet: bool) -> Iterator[Listener]:
    """A listener for the events of a run."""
    if quiet:
        yield _warnings_alone
    elif console(stderr=True).is_terminal:
        with _bar() as listener:
            yield listener
    else:
        yield _Lines()


def _warnings_alone(event: Event) -> None:
    if event["event"] == "warning":
        print_remark(f"warning: {event['message']}")


class _Lines:
    """Plain lines: compiled, every tenth of the way or every stage, warnings."""

    def __init__(self) -> None:
        self.tenth = 0
        self.began = self.spoke = time.monotonic()

    def __call__(self, event: Event) -> None:
        _warnings_alone(event)
        if event["event"] == "compiled":
            print_remark(f"compiled in {event['compile_seconds']:.1f} s")
            self.began = self.spoke = time.monotonic()
        elif event["event"] == "stage":
            print_remark(event["stage"])
        elif event["event"] == "progress":
            self._advance(event)

    def _advance(self, event: Event) -> None:
        done = float(event["t"]) / float(event["t_end"])
        now = time.monotonic()
        if int(done * LINES) <= self.tenth and now - self.spoke < SECONDS_BETWEEN:
            return
        self.tenth, self.spoke = int(done * LINES), now
        left = (now - self.began) * (1 - done) / done if done > 0 else float("nan")
        print_remark(f"{_where(event)} ({done:.0%}), {left:.0f} s left")


def _where(event: Event) -> str:
    """Return the text of an event of progress, else its time and its steps with their method."""
    if "where" in event:
        return event["where"]
    time_text = f"t = {event['t']:.6g} of {event['t_end']:.6g} {event.get('unit', '')}".rstrip()
    method = str(event.get("method", "")).partition(":")[0]
    return f"{time_text}, {event['steps']} steps" + (f" of {method}" if method else "")


@contextmanager
def _bar() -> Iterator[Listener]:
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TextColumn("{task.fields[where]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console(stderr=True)) as bar:
        task = bar.add_task("compiling", total=None, where="")

        def listen(event: Event) -> None:
            kind = event["event"]
            if kind == "warning":
                bar.console.print(f"warning: {event['message']}", markup=False, style="yellow")
            elif kind == "compiled":
                seconds = event["compile_seconds"]
                bar.console.print(f"compiled in {seconds:.1f} s", markup=False)
                bar.reset(task, description="solving", where="")
            elif kind == "stage":
                bar.update(task, description=event["stage"])
            elif kind == "progress":
                done, total = event["t"], event["t_end"]
                bar.update(task, completed=done, total=total, where=_where(event))

        yield listen
