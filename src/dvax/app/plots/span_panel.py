"""A panel with spans of time: a row for each constraint, a bar while it is active."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes

from dvax.app.plots.panels import AbstractPanel
from dvax.app.plots.theme import SERIES, unit_text

_HEIGHT = 0.6


@dataclass(frozen=True)
class Spans:
    """A row: its name, and the beginnings and ends of its spans."""

    name: str
    begin: np.ndarray
    end: np.ndarray
    colour: int = 0


@dataclass(frozen=True)
class SpanPanel(AbstractPanel):
    """Rows of spans, the first on top."""

    rows: tuple[Spans, ...]
    words: str
    unit: str = ""
    share: float = field(default=1.0)
    has_row_names: ClassVar[bool] = True

    @property
    def has_legend(self) -> bool:
        return False

    @property
    def description(self) -> str:
        names = ", ".join(row.name for row in self.rows)
        return f"{self.words}: spans of {names}"

    def traces(self, words: str, unit: str) -> list[Any]:
        return [
            go.Bar(
                x=row.end - row.begin, base=row.begin, y=[row.name] * len(row.begin), orientation="h",
                width=_HEIGHT, marker=dict(color=SERIES[row.colour % len(SERIES)]), customdata=row.end,
                hovertemplate=f"{row.name} from {words} %{{base:.5g}} to %{{customdata:.5g}} "
                f"{unit_text(unit)}<extra></extra>",
            )
            for row in self.rows
        ]  # fmt: skip

    def axis(self) -> dict[str, Any]:
        names = [row.name for row in self.rows]
        return dict(
            title_text=self.words, type="category", categoryarray=names, showgrid=False,
            range=[len(names) - 0.5, -0.5],
        )  # fmt: skip

    def draw(self, axes: Axes) -> None:
        for k, row in enumerate(self.rows):
            bars = np.column_stack([row.begin, row.end - row.begin])
            colour = SERIES[row.colour % len(SERIES)]
            axes.broken_barh(list(map(tuple, bars)), (k - _HEIGHT / 2, _HEIGHT), facecolors=colour)
        axes.set_yticks(range(len(self.rows)), [row.name for row in self.rows])
        axes.set_ylim(len(self.rows) - 0.5, -0.5)
        axes.grid(False, axis="y")
        axes.set_ylabel(self.words + "\n")
