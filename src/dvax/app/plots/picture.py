"""A picture of the report: an interactive figure, a still one, and a caption."""

from collections.abc import Callable
from dataclasses import dataclass

import plotly.graph_objects as go
from matplotlib.figure import Figure


@dataclass(frozen=True)
class Views:
    """Alternative views, one of which is visible at a time: trace i of the figure belongs to
    `labels[i]`.

    `slider` chooses a slider instead of buttons; `name` says what is being chosen; `first` is
    the one that shows when the page opens.
    """

    name: str
    labels: tuple[str, ...]
    slider: bool = False
    first: int = 0


@dataclass(frozen=True)
class Picture:
    """One picture. `key` names it in the page and its PNG; `still` draws the PNG's figure."""

    key: str
    title: str
    caption: str
    interactive: go.Figure
    still: Callable[[], Figure]
    views: Views | None = None
