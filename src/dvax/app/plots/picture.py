"""A picture of the report: an interactive figure, a still one, and words."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import plotly.graph_objects as go
from matplotlib.figure import Figure


@dataclass(frozen=True)
class Views:
    """Alternative views, one of which is visible at a time: trace i of the figure belongs to
    `labels[i]`. `name` says what the buttons choose."""

    name: str
    labels: tuple[str, ...]


@dataclass(frozen=True)
class Change:
    """What a trace shows at the chosen instant: `attribute` ("y", "z", "marker.color") is row k of
    `values`, or column k of the map that is a trace of another picture, `section` = (key, trace)."""

    trace: int
    attribute: str
    values: np.ndarray | None = None
    section: tuple[str, int] | None = None


@dataclass(frozen=True)
class Frames:
    """The instants that a slider goes through: `times`, the text of each, what changes with them, and
    the one that is shown first."""

    times: np.ndarray
    labels: tuple[str, ...]
    changes: tuple[Change, ...]
    first: int = 0


@dataclass(frozen=True)
class Picture:
    """One picture. `key` names it in the page and its PNG; `still` draws the PNG's figure.

    Pictures with the same `zoom`, the title of their horizontal axes, are zoomed together.
    `alternative` says what the picture shows, for a reader who does not see it."""

    key: str
    title: str
    caption: str
    interactive: go.Figure
    still: Callable[[], Figure]
    views: Views | None = None
    frames: Frames | None = None
    zoom: str = ""
    alternative: str = field(kw_only=True)

    @property
    def description(self) -> str:
        """What the picture shows, in words alone."""
        return f"{self.title}. {self.alternative}"
