"""Curves in panels one above the other that share the horizontal axis."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dvax.app.plots.lines import positive, thin
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable
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
_DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-.", "longdash": (0, (8, 3))}
_LEGEND_CHARACTERS = 100
"""About as many fit beside each other above a still picture."""


@dataclass(frozen=True)
class Curve:
    """y over x. `colour` counts through the theme's series; None is the grey of what is for
    comparison. `marks` draws points in the place of a line, as for a single point."""

    x: np.ndarray
    y: np.ndarray
    name: str
    colour: int | None = 0
    dash: str = "solid"
    marks: bool = False

    @property
    def ink(self) -> str:
        return MUTED if self.colour is None else SERIES[self.colour % len(SERIES)]

    @property
    def as_marks(self) -> bool:
        return self.marks or len(self.x) == 1


@dataclass(frozen=True)
class Panel:
    """Curves under one vertical axis; `log` for a logarithmic one, on which values that it cannot
    show are gaps. `share` is the height of the panel relative to the others."""

    curves: list[Curve]
    words: str
    unit: str = ""
    log: bool = False
    share: float = field(default=1.0)

    def __post_init__(self) -> None:
        if self.log:
            shown = [replace(curve, y=positive(curve.y)) for curve in self.curves]
            object.__setattr__(self, "curves", shown)

    def axis(self) -> dict[str, Any]:
        """The vertical axis for Plotly."""
        unit = unit_text(self.unit)
        title = self.words + (f"<br>[{unit}]" if unit else "")
        return dict(title_text=title, **(self._logarithmic() if self.log else {}))

    def _logarithmic(self) -> dict[str, Any]:
        """Whole decades between ticks, at most about eight of them: 2 × 10⁻⁷ is no landmark."""
        values = np.concatenate([curve.y for curve in self.curves])
        values = values[np.isfinite(values)]
        decades = float(np.ptp(np.log10(values))) if values.size else 0.0
        # Within one decade Plotly chooses the ticks.
        return dict(**_LOGARITHMIC, dtick=math.ceil(decades / 8) if decades > 1.0 else None)


def bound_panel(x: np.ndarray, bound: Variable, unit: str, colour: int = 1, **more: Any) -> Panel:
    """An error bound on a logarithmic axis, with the word for how much is known of it."""
    known = f" ({bound.status})" if bound.status else ""
    curve = Curve(x, bound.values, f"error bound{known}", colour)
    return Panel([curve], f"error bound{known.replace(' ', '<br>')}", unit, log=True, **more)


def bound_title(bound: Variable) -> str:
    """Return the title of a picture of a bound: only a proved bound is called certified."""
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
            shows = len(panel.curves) > 1 and curve.name not in named
            figure.add_trace(_trace(curve, panel, words, unit, shows), row, 1)
            named |= {curve.name} if shows else set()
        figure.update_yaxes(**panel.axis(), row=row, col=1)
    if log:
        figure.update_xaxes(**_LOGARITHMIC)
    figure.update_xaxes(title_text=axis_title(words, unit), row=len(panels), col=1)

    def still() -> Figure:
        with rc_context(STILL_STYLE):
            drawn, axes = still_axes(
                len(panels), 1, figsize=(8, 1.2 + 2.4 * len(panels)), sharex=True, squeeze=False,
                height_ratios=shares,
            )  # fmt: skip
            named: set[str] = set()
            for place, panel in zip(axes[:, 0], panels, strict=True):
                for c in panel.curves:
                    style = dict(linestyle=_DASHES[c.dash], linewidth=1.3)
                    if c.as_marks:
                        style = dict(linestyle="", marker="o", markersize=4)
                    place.plot(c.x, c.y, color=c.ink, label=c.name, **style)
                place.set_ylabel(axis_title(panel.words.replace("<br>", "\n") + "\n", panel.unit))
                place.set_yscale("log" if panel.log else "linear")
                _add_legend(place, panel, named)
            axes[0, 0].set_xscale("log" if log else "linear")
            drawn.suptitle(title, x=0.01, ha="left", fontsize=11)
            axes[-1, 0].set_xlabel(axis_title(words, unit))
            drawn.align_ylabels()
        return drawn

    return Picture(key=key, title=title, caption=caption, interactive=figure, still=still)


def _add_legend(axes: Axes, panel: Panel, named: set[str]) -> None:
    """Name the curves above the panel, but for those that a panel above has named."""
    by_name = {line.get_label(): line for line in axes.lines if line.get_label() not in named}
    handles = list(by_name.values())
    if len(panel.curves) == 1 or not handles:
        return
    names = [str(line.get_label()) for line in handles]
    named.update(names)
    columns = max(1, min(4, _LEGEND_CHARACTERS // (max(map(len, names)) + 8)))
    axes.legend(
        handles=handles, ncols=columns, loc="lower left", bbox_to_anchor=(0, 1.0), fontsize=9,
        borderpad=0.2,
    )  # fmt: skip


def _trace(curve: Curve, panel: Panel, words: str, unit: str, shows: bool) -> go.Scatter:
    marks = curve.as_marks
    shown = slice(None) if marks else thin(curve.x, curve.y)
    return go.Scatter(
        x=curve.x[shown],
        y=curve.y[shown],
        name=curve.name,
        legendgroup=curve.name,
        showlegend=shows,
        mode="markers" if marks else "lines",
        line=None if marks else dict(color=curve.ink, width=1.6, dash=curve.dash),
        marker=dict(color=curve.ink, size=6) if marks else None,
        hovertemplate=f"%{{y:.5g}} {unit_text(panel.unit)} at {words} %{{x:.5g}} {unit_text(unit)}",
    )
