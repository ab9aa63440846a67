"""A section of a map at one time, which a slider chooses: a profile over the places."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.figure import Figure

from dvax.app.plots.panels import DASHES, Curve, Panel, draw_panels, value_range
from dvax.app.plots.picture import Change, Frames, Picture
from dvax.app.plots.theme import (
    BLUE,
    MUTED,
    STILL_STYLE,
    axis_title,
    blank,
    number,
    still_axes,
    unit_text,
)

_STILLS = 5


class Axis(NamedTuple):
    """The words and the unit of an axis."""

    words: str
    unit: str

    @property
    def title(self) -> str:
        return axis_title(self.words, self.unit)


def section_picture(
    of: str,
    title: str,
    caption: str,
    places: np.ndarray,
    times: np.ndarray,
    values: np.ndarray,
    across: Axis,
    upward: Axis,
    time_unit: str,
    references: Sequence[Curve] = (),
) -> Picture:
    """Return the picture of profiles over `places` at one of `times`.

    `values`, of shape (times, places), is the map that is the first trace of the picture `of`; the
    profiles are its columns. `references` are curves that do not change.
    """
    values = np.where(np.isfinite(values), values, np.nan)
    # The time of the largest values: a profile at rest shows nothing.
    first = int(np.argmax(np.nan_to_num(np.abs(values)).mean(axis=1)))
    figure = blank(360)
    line = dict(color=BLUE, dash="solid", width=1.8)
    _add(figure, places, values[first], upward.words, line, upward.unit)
    for curve in references:
        _add(figure, curve.x, curve.y, curve.name, dict(color=MUTED, dash=curve.dash), upward.unit)
    shown = [values, *(curve.y for curve in references)]
    figure.update_layout(hovermode="x unified", showlegend=len(shown) > 1)
    figure.update_xaxes(
        title_text=across.title, hoverformat=".6~g",
        unifiedhovertitle_text=f"{across.words} %{{x}} {unit_text(across.unit)}",
    )  # fmt: skip
    figure.update_yaxes(title_text=upward.title, range=_ends(shown))
    labels = tuple(f"t = {number(float(t))} {unit_text(time_unit)}".rstrip() for t in times)
    change = Change(0, "y", section=(of, 0))

    def still() -> Figure:
        rows = np.unique(np.linspace(0, len(times) - 1, _STILLS).round().astype(int))
        curves = [Curve(places, values[k], labels[k], i, DASHES[i]) for i, k in enumerate(rows)]
        panel = Panel([*curves, *references], upward.words, upward.unit)
        with rc_context(STILL_STYLE):
            drawn, axes = still_axes(figsize=(8, 3.8))
            draw_panels([panel], [axes], across.words, across.unit)
            drawn.suptitle(title, x=0.01, ha="left", fontsize=11)
        return drawn

    return Picture(
        f"{of}-section", title, caption, figure, still, frames=Frames(times, labels, (change,), first),
        alternative=f"{upward.title}{value_range(*shown)} over {across.title}, at {len(times)} times "
        "that a slider chooses.",
    )  # fmt: skip


def _add(
    figure: go.Figure, x: np.ndarray, y: np.ndarray, name: str, line: dict[str, Any], unit: str
) -> None:
    read_out = f"%{{y:.5g}} {unit_text(unit)}"
    figure.add_trace(
        go.Scatter(x=x, y=y, name=name, mode="lines", line=line, hovertemplate=read_out)
    )


def _ends(shown: Sequence[np.ndarray]) -> list[float]:
    """The ends of an axis that holds all profiles, so that it stays the same over time."""
    low = min((float(np.nanmin(v)) for v in shown if np.isfinite(v).any()), default=0.0)
    high = max((float(np.nanmax(v)) for v in shown if np.isfinite(v).any()), default=1.0)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return [low - margin, high + margin]
