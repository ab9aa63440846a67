"""Curves in panels one above the other, that share the horizontal axis: most pictures are that."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.figure import Figure

from dvax.app.plots.applications.data import Data
from dvax.app.plots.lines import thin
from dvax.app.plots.picture import Picture
from dvax.app.plots.theme import (
    MUTED,
    SERIES,
    STILL_STYLE,
    axis_title,
    blank,
    still_axes,
    unit_text,
)

# Powers of ten, where Plotly would write 1µ and 1f.
_LOGARITHMIC = dict(type="log", exponentformat="power", showexponent="all")
_DASHES = {"solid": "-", "dash": "--", "dot": ":"}


@dataclass(frozen=True)
class Curve:
    """y over x. `colour` counts through the house's series; None is the grey of what is for
    comparison. `marks` draws points in the place of a line."""

    x: np.ndarray
    y: np.ndarray
    name: str
    colour: int | None = 0
    dash: str = "solid"
    marks: bool = False

    @property
    def ink(self) -> str:
        return MUTED if self.colour is None else SERIES[self.colour % len(SERIES)]


@dataclass(frozen=True)
class Panel:
    """Curves under one vertical axis; `log` for a logarithmic one."""

    curves: Sequence[Curve]
    words: str
    unit: str = ""
    log: bool = False
    share: float = field(default=1.0)


def bound_panel(x: np.ndarray, bound: Data, unit: str, colour: int = 1, **more: Any) -> Panel:
    """An error bound on a logarithmic axis, with the word for how much is known of it."""
    shown = np.where(bound.values > 0, bound.values, np.nan)
    known = f" ({bound.status})" if bound.status else ""
    words = f"error bound{known.replace(' ', '<br>')}"
    return Panel([Curve(x, shown, f"error bound{known}", colour)], words, unit, log=True, **more)


def bound_title(bound: Data) -> str:
    """What a picture of a bound is called: nothing is certified but what is proved."""
    return "Certified error" if bound.status == "proved" else f"Error bound, {bound.status}"


def panels_picture(
    key: str,
    title: str,
    caption: str,
    panels: Sequence[Panel],
    words: str,
    unit: str = "",
    *,
    log: bool = False,
) -> Picture:
    """The picture of these panels over the common axis `words [unit]`."""
    shares = tuple(panel.share / sum(p.share for p in panels) for panel in panels)
    named: set[str] = set()
    figure = blank(150 + 240 * len(panels), shares)
    for row, panel in enumerate(panels, start=1):
        for curve in panel.curves:
            figure.add_trace(_trace(curve, panel, words, unit, curve.name not in named), row, 1)
            named.add(curve.name)
        over = f"<br>[{unit_text(panel.unit)}]" if unit_text(panel.unit) else ""
        figure.update_yaxes(
            title_text=panel.words + over, row=row, col=1,
            **(_LOGARITHMIC if panel.log else {}),
        )  # fmt: skip
    if log:
        figure.update_xaxes(**_LOGARITHMIC)
    figure.update_xaxes(title_text=axis_title(words, unit), row=len(panels), col=1)

    def still() -> Figure:
        with rc_context(STILL_STYLE):
            drawn, axes = still_axes(
                len(panels), 1, figsize=(8, 1.2 + 2.4 * len(panels)), sharex=True, squeeze=False,
                height_ratios=shares,
            )  # fmt: skip
            for place, panel in zip(axes[:, 0], panels, strict=True):
                told: set[str] = set()
                for c in panel.curves:
                    style = dict(color=c.ink, label="_" if c.name in told else c.name)
                    told.add(c.name)
                    if c.marks:
                        place.plot(c.x, c.y, "o", markersize=4, **style)
                    else:
                        place.plot(c.x, c.y, _DASHES[c.dash], linewidth=1.3, **style)
                place.set_ylabel(axis_title(panel.words.replace("<br>", "\n") + "\n", panel.unit))
                place.set_yscale("log" if panel.log else "linear")
                if len(panel.curves) > 1:
                    place.legend(
                        ncols=4,
                        loc="lower left",
                        bbox_to_anchor=(0, 1.0),
                        fontsize=9,
                        borderpad=0.2,
                    )
            axes[0, 0].set_xscale("log" if log else "linear")
            drawn.suptitle(title, x=0.01, ha="left", fontsize=11)
            axes[-1, 0].set_xlabel(axis_title(words, unit))
            drawn.align_ylabels()
        return drawn

    return Picture(key=key, title=title, caption=caption, interactive=figure, still=still)


def _trace(curve: Curve, panel: Panel, words: str, unit: str, first: bool) -> go.Scatter:
    shown = thin(curve.x, curve.y) if not curve.marks else slice(None)
    line = dict(color=curve.ink, width=1.6, dash=curve.dash)
    return go.Scatter(
        x=curve.x[shown],
        y=curve.y[shown],
        name=curve.name,
        legendgroup=curve.name,
        showlegend=first,
        mode="markers" if curve.marks else "lines",
        line=None if curve.marks else line,
        marker=dict(color=curve.ink, size=6) if curve.marks else None,
        hovertemplate=f"%{{y:.5g}} {unit_text(panel.unit)} at {words} %{{x:.5g}} {unit_text(unit)}",
    )
