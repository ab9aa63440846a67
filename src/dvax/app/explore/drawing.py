"""Figures for Plotly as plain dictionaries, in the theme of the report.

Plotly's own classes check every property, which takes longer than a solve.
"""

from copy import deepcopy
from functools import cache
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dvax.app.explore.subject import Drawing
from dvax.app.plots.picture import Picture
from dvax.app.plots.theme import SERIES, axis_title, blank

PREDICTED = SERIES[4]
POWERS = dict(type="log", exponentformat="power", showexponent="all")


@cache
def _blank(height: int) -> dict[str, Any]:
    return go.Figure(blank(height)).to_plotly_json()["layout"]


def layout(
    height: int, across: tuple[str, str], upward: tuple[str, str], **more: Any
) -> dict[str, Any]:
    """Return the layout of a figure whose axes have these (words, unit); `more` is merged into it."""
    found = deepcopy(_blank(height))
    found["xaxis"] |= {"title": {"text": axis_title(*across)}}
    found["yaxis"] |= {"title": {"text": axis_title(*upward)}}
    for key, value in more.items():
        found[key] = found.get(key, {}) | value if isinstance(value, dict) else value
    return found


def line(
    x: np.ndarray, y: np.ndarray, name: str, colour: str, dash: str = "solid", **more: Any
) -> dict[str, Any]:
    """Return a curve. Single precision is finer than any screen."""
    return {
        "type": "scatter", "mode": "lines", "x": single(x), "y": single(y), "name": name,
        "line": {"color": colour, "width": 1.8, "dash": dash}, **more,
    }  # fmt: skip


def single(values: Any) -> np.ndarray:
    """Return values in single precision; what overflows it is infinite, which is a gap."""
    with np.errstate(over="ignore"):
        return np.asarray(values, dtype=np.float32)


def of_picture(picture: Picture, has_time: bool = False) -> Drawing:
    """Return the drawing of a picture of the report."""
    figure = picture.interactive.to_plotly_json()
    return Drawing(
        picture.key, picture.title, picture.caption, list(figure["data"]), figure["layout"],
        picture.views, has_time,
    )  # fmt: skip
