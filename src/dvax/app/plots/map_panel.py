"""A panel with a map: time to the right, the entries of a field upward, values as colours."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes

from dvax.app.plots.downsample import SPACE_CELLS, TIME_CELLS, edges, rounded, starts
from dvax.app.plots.panels import AbstractPanel, value_range
from dvax.app.plots.theme import PRESSURE_MAP, axis_title, unit_text


@dataclass(frozen=True)
class MapPanel(AbstractPanel):
    """Values (times, entries) at times `x`. Above the resolution of a screen, a cell shows the mean of
    neighbouring entries and times."""

    x: np.ndarray
    values: np.ndarray
    name: str
    words: str
    unit: str = ""
    share: float = field(default=1.0)

    @property
    def entry(self) -> str:
        """The words of a read-out for one entry."""
        return "entry %{y:.0f}" if self.places is None else "place %{y:.4g}"

    @property
    def has_legend(self) -> bool:
        return False

    @property
    def description(self) -> str:
        title = axis_title(self.name, self.unit)
        return f"a map of {title}{value_range(self.values)}, {self.words} upward"

    places: np.ndarray | None = None
    """Of the entries; their numbers if not given."""

    def cells(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the edges of the cells along time and along the entries, and their means."""
        frames, entries = self.values.shape
        begin, low = starts(frames, TIME_CELLS), starts(entries, SPACE_CELLS)
        sums = np.add.reduceat(np.add.reduceat(self.values, begin, axis=0), low, axis=1)
        counts = np.outer(np.diff([*begin, frames]), np.diff([*low, entries]))
        places = np.arange(entries + 1) - 0.5 if self.places is None else edges(self.places)
        return edges(self.x)[[*begin, frames]], places[[*low, entries]], sums / counts

    def traces(self, words: str, unit: str) -> list[Any]:
        across, upward, means = self.cells()
        bar = axis_title(self.name, self.unit)
        return [
            go.Heatmap(
                x=across, y=upward, z=rounded(means.T), colorscale=PRESSURE_MAP,
                colorbar=dict(title=dict(text=bar, side="right"), thickness=14),
                hovertemplate=f"%{{z:.4g}} {unit_text(self.unit)} in {self.entry} at {words} "
                f"%{{x:.5g}} {unit_text(unit)}<extra></extra>",
            )
        ]  # fmt: skip

    def axis(self) -> dict[str, Any]:
        return dict(title_text=self.words, showgrid=False)

    def draw(self, axes: Axes) -> None:
        across, upward, means = self.cells()
        image = axes.pcolormesh(across, upward, means.T, cmap=PRESSURE_MAP, rasterized=True)
        axes.grid(False)
        axes.set_ylabel(self.words)
        axes.figure.colorbar(image, ax=axes, label=axis_title(self.name, self.unit), pad=0.01)
