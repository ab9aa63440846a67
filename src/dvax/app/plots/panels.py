"""Curves in panels one above the other that share the horizontal axis."""

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dvax.app.plots.lines import positive, thin
from dvax.app.plots.picture import Picture
from dvax.app.plots.theme import (
    MUTED,
    SERIES,
    STILL_STYLE,
    axis_title,
    blank,
    number,
    still_axes,
    unit_text,
)

# Powers of ten, where Plotly would write 1µ and 1f.
_LOGARITHMIC = dict(type="log", exponentformat="power", showexponent="all")
DASHES = ("solid", "dash", "dot", "dashdot", "longdash")
"""Of curves beside each other, so that they differ without their colours."""
_DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-.", "longdash": (0, (8, 3))}
_PALE = 0.2
"""The opacity of bands."""
_LEAST_DECADES, _LEAST_SPREAD = 0.5, 1e-6
"""Values within less than this are drawn on an axis of fixed ends."""
_LEGEND_CHARACTERS = 100
"""About as many fit beside each other above a still picture."""


@dataclass(frozen=True)
class Curve:
    """y over x. `colour` counts through the theme's series; None is the grey of what is for
    comparison. `marks` draws points in the place of a line, as for a single point; `dots` draws them on
    the line, where each was computed by itself."""

    x: np.ndarray
    y: np.ndarray
    name: str
    colour: int | None = 0
    dash: str = "solid"
    marks: bool = False
    dots: bool = False

    @property
    def ink(self) -> str:
        return MUTED if self.colour is None else SERIES[self.colour % len(SERIES)]

    @property
    def as_marks(self) -> bool:
        return self.marks or len(self.x) == 1

    @property
    def is_visible(self) -> bool:
        """Whether it has a point, or a line between two."""
        finite = np.isfinite(np.asarray(self.y, float))
        return bool((finite if self.as_marks or self.dots else finite[1:] & finite[:-1]).any())


@dataclass(frozen=True)
class Band:
    """The area between `low` and `high` over x, in the pale colour of a curve."""

    x: np.ndarray
    low: np.ndarray
    high: np.ndarray
    name: str
    colour: int | None = 0

    @property
    def ink(self) -> str:
        return MUTED if self.colour is None else SERIES[self.colour % len(SERIES)]


class AbstractPanel(abc.ABC):
    """One panel of a picture.

    - `words`, `unit`: of its vertical axis; `share`: its height relative to the other panels;
    - `has_legend`: whether what it shows is named above it.
    """

    words: str
    unit: str
    share: float
    has_row_names: ClassVar[bool] = False
    """Whether its vertical axis has names in the place of numbers."""

    @property
    @abc.abstractmethod
    def has_legend(self) -> bool: ...

    @property
    @abc.abstractmethod
    def description(self) -> str:
        """What it shows, in words."""

    @abc.abstractmethod
    def traces(self, words: str, unit: str) -> list[Any]:
        """Return the traces for Plotly; `words [unit]` is the horizontal axis."""

    @abc.abstractmethod
    def axis(self) -> dict[str, Any]:
        """Return the vertical axis for Plotly."""

    @abc.abstractmethod
    def draw(self, axes: Axes) -> None:
        """Draw with Matplotlib."""


@dataclass(frozen=True)
class Panel(AbstractPanel):
    """Curves under one vertical axis; `log` for a logarithmic one, on which values that it cannot
    show are gaps. `share` is the height of the panel relative to the others; `bands` lie behind the
    curves."""

    curves: list[Curve]
    words: str
    unit: str = ""
    log: bool = False
    share: float = field(default=1.0)
    bands: tuple[Band, ...] = ()

    def __post_init__(self) -> None:
        if self.log:
            shown = [replace(curve, y=positive(curve.y)) for curve in self.curves]
            object.__setattr__(self, "curves", shown)

    @property
    def has_legend(self) -> bool:
        return len(self.curves) + len(self.bands) > 1

    @property
    def description(self) -> str:
        names = [item.name for item in (*self.bands, *self.curves) if item.name]
        drawn = f": {', '.join(dict.fromkeys(names))}" if self.has_legend else ""
        title = axis_title(self.words.replace("<br>", " "), self.unit)
        ends = value_range(*(c.y for c in self.curves))
        return f"{title}{ends}{drawn}"

    @property
    def is_over_time(self) -> bool:
        """Whether the abscissae of all curves increase, so that a place has one value of each."""
        return all(not (np.diff(curve.x) < 0).any() for curve in self.curves)

    def traces(self, words: str, unit: str) -> list[Any]:
        bands = [_band_trace(band) for band in self.bands]
        return bands + [_trace(curve, self, words, unit) for curve in self.curves]

    def draw(self, axes: Axes) -> None:
        for band in self.bands:
            axes.fill_between(
                band.x,
                band.low,
                band.high,
                color=band.ink,
                alpha=_PALE,
                linewidth=0,
                label=band.name,
            )
        for c in self.curves:
            style: dict[str, Any] = dict(linestyle=_DASHES[c.dash], linewidth=1.3)
            if c.as_marks:
                style = dict(linestyle="", marker="o", markersize=4)
            elif c.dots:
                style |= dict(marker="o", markersize=3.5)
            axes.plot(c.x, c.y, color=c.ink, label=c.name, **style)
        axes.set_ylabel(axis_title(self.words.replace("<br>", "\n") + "\n", self.unit))
        axes.set_yscale("log" if self.log else "linear")
        ends = self._ends()
        if ends is not None:
            axes.set_ylim(ends)
        if not self._has_values:
            axes.set_yticks([], [])
            axes.tick_params(axis="y", which="both", length=0, labelleft=False)

    def axis(self) -> dict[str, Any]:
        unit = unit_text(self.unit)
        title = self.words + (f"<br>[{unit}]" if unit else "")
        ends = self._ends()
        about: dict[str, Any] = dict(title_text=title, showticklabels=self._has_values)
        if ends is not None:
            about["range"] = list(np.log10(ends)) if self.log else list(ends)
        return about | (self._logarithmic() if self.log else {})

    @property
    def _has_values(self) -> bool:
        """Whether anything is drawn: an axis without values would have invented numbers."""
        bands = _finite(*(band.low for band in self.bands)).size > 0
        return bands or any(curve.is_visible for curve in self.curves)

    def _ends(self) -> tuple[float, float] | None:
        """The ends of the vertical axis where the values lie so close that it would show roundoff:
        a whole decade on a logarithmic axis, 10⁻⁶ of the values on a linear one. None elsewhere."""
        values = _finite(*(curve.y for curve in self.curves), *(band.low for band in self.bands))
        if not values.size:
            return None
        low, high = float(values.min()), float(values.max())
        if self.log:
            if high > low * 10**_LEAST_DECADES:
                return None
            begin = math.floor(math.log10(low))
            return 10.0**begin, 10.0 ** max(begin + 1, math.ceil(math.log10(high)))
        if high - low >= _LEAST_SPREAD * max(abs(low), abs(high)):
            return None
        # The axis of a constant begins at zero.
        return min(0.0, 1.2 * low), max(0.0, 1.2 * high)

    def _logarithmic(self) -> dict[str, Any]:
        """Whole decades between ticks, at most about eight of them: 2 × 10⁻⁷ is no landmark."""
        values = _finite(*(curve.y for curve in self.curves))
        decades = float(np.ptp(np.log10(values))) if values.size else 0.0
        # Over few decades 2 and 5 have ticks, too.
        return dict(**_LOGARITHMIC, dtick="D2" if decades < 2 else math.ceil(decades / 8))


@dataclass(frozen=True)
class TimeMarks:
    """Times that a vertical line marks in every panel, such as those of an event."""

    x: np.ndarray
    name: str
    dash: str = "dot"


def panels_picture(
    key: str,
    title: str,
    caption: str,
    panels: Sequence[AbstractPanel],
    words: str,
    unit: str = "",
    *,
    log: bool = False,
    marks: Sequence[TimeMarks] = (),
) -> Picture:
    """The picture of these panels over the common axis `words [unit]`."""
    shares = tuple(panel.share / sum(p.share for p in panels) for panel in panels)
    heights = sum(panel.share for panel in panels)
    named: set[str] = set()
    figure = blank(round(150 + 240 * heights), shares)
    for row, panel in enumerate(panels, start=1):
        figure.update_yaxes(**panel.axis(), row=row, col=1)
        low, high = figure.layout[_axis("yaxis", row)].domain
        lines = [_marks_trace(m) for m in marks] if row == 1 else []
        for trace in [*panel.traces(words, unit), *lines]:
            if trace.type == "heatmap":
                trace.colorbar.update(
                    y=(low + high) / 2, yanchor="middle", len=high - low, lenmode="fraction"
                )
            shows = trace.showlegend is not False and bool(trace.name)
            shows &= (panel.has_legend or trace in lines) and trace.name not in named
            trace.update(showlegend=shows, legendgroup=trace.name)
            named |= {str(trace.name)} if shows else set()
            figure.add_trace(trace, row, 1)
    # All at once: Plotly checks all shapes of a figure at each addition.
    figure.update_layout(
        shapes=[
            dict(
                type="line", x0=float(x), x1=float(x), y0=0, y1=1, xref=_axis("x", row),
                yref=_axis("y", row) + " domain", line=dict(color=MUTED, width=1, dash=m.dash),
            )
            for row in range(1, len(panels) + 1) for m in marks for x in m.x
        ]
    )  # fmt: skip
    if log:
        figure.update_xaxes(**_LOGARITHMIC)
    title_of_x = axis_title(words, unit)
    figure.update_xaxes(title_text=title_of_x, row=len(panels), col=1)
    if not log and all(isinstance(panel, Panel) and panel.is_over_time for panel in panels):
        # One read-out of all curves of a panel; %{x} is its head.
        figure.update_layout(hovermode="x unified")
        figure.update_xaxes(
            hoverformat=".6~g", unifiedhovertitle_text=f"{words} %{{x}} {unit_text(unit)}"
        )
    elif not log and all(isinstance(panel, Panel) for panel in panels):
        # Lines touch the ends of an axis that Plotly chooses, where a path in a plane looks cut off.
        across = _finite(
            *(c.x for panel in panels if isinstance(panel, Panel) for c in panel.curves)
        )
        if across.size and (margin := 0.03 * float(np.ptp(across))) > 0:
            figure.update_xaxes(range=[float(across.min()) - margin, float(across.max()) + margin])

    def still() -> Figure:
        with rc_context(STILL_STYLE):
            drawn, axes = still_axes(
                len(panels), 1, figsize=(8, 1.2 + 2.4 * heights), sharex=True, squeeze=False,
                height_ratios=shares,
            )  # fmt: skip
            draw_panels(panels, list(axes[:, 0]), words, unit, marks)
            axes[0, 0].set_xscale("log" if log else "linear")
            drawn.suptitle(title, x=0.01, ha="left", fontsize=11)
            # Long names of rows would push all labels away from their axes.
            drawn.align_ylabels([a for a, p in zip(axes[:, 0], panels) if not p.has_row_names])
        return drawn

    shown = "; ".join(panel.description for panel in panels)
    return Picture(
        key=key, title=title, caption=caption, interactive=figure, still=still, zoom=title_of_x,
        alternative=f"Over {title_of_x}: {shown}.",
    )  # fmt: skip


def value_range(*arrays: np.ndarray) -> str:
    """Return " from … to …" of the finite values of these arrays; nothing where there are none."""
    values = _finite(*arrays)
    return (
        f" from {number(float(values.min()))} to {number(float(values.max()))}"
        if values.size
        else ""
    )


def _finite(*arrays: np.ndarray) -> np.ndarray:
    values = np.concatenate([np.ravel(array) for array in arrays] or [np.empty(0)]).astype(float)
    return values[np.isfinite(values)]


def _axis(name: str, row: int) -> str:
    """Return Plotly's name of an axis: the first has no number."""
    return name if row == 1 else f"{name}{row}"


def draw_panels(
    panels: Sequence[AbstractPanel],
    axes: Sequence[Axes],
    words: str,
    unit: str = "",
    marks: Sequence[TimeMarks] = (),
) -> None:
    """Draw each panel into its axes with Matplotlib."""
    named: set[str] = set()
    for place, panel in zip(axes, panels, strict=True):
        panel.draw(place)
        lines = []
        for m in marks:
            style: dict[str, Any] = dict(color=MUTED, linestyle=_DASHES[m.dash], linewidth=1.0)
            lines.append((Line2D([], [], **style), m.name))
            for x in m.x:
                place.axvline(float(x), **style)
        _add_legend(place, panel, named, lines)
    axes[-1].set_xlabel(axis_title(words, unit))


def _add_legend(axes: Axes, panel: AbstractPanel, named: set[str], lines: Sequence[Any]) -> None:
    """Name what the panel shows above it, but for what a panel above has named."""
    shown = list(zip(*axes.get_legend_handles_labels(), strict=True)) if panel.has_legend else []
    entries = {name: handle for handle, name in (*shown, *lines) if name not in named}
    if not entries:
        return
    named.update(entries)
    columns = max(1, min(4, _LEGEND_CHARACTERS // (max(map(len, entries)) + 8)))
    axes.legend(
        handles=list(entries.values()), labels=list(entries), ncols=columns, loc="lower left",
        bbox_to_anchor=(0, 1.0), fontsize=9, borderpad=0.2,
    )  # fmt: skip


def _trace(curve: Curve, panel: Panel, words: str, unit: str) -> go.Scatter:
    marks = curve.as_marks
    shown = slice(None) if marks else thin(curve.x, curve.y)
    place = f" at {words} %{{x:.5g}} {unit_text(unit)}"
    return go.Scatter(
        x=curve.x[shown],
        y=curve.y[shown],
        name=curve.name,
        mode="markers" if marks else "lines+markers" if curve.dots else "lines",
        line=None if marks else dict(color=curve.ink, width=1.6, dash=curve.dash),
        marker=dict(color=curve.ink, size=6 if marks else 5) if marks or curve.dots else None,
        hovertemplate=f"%{{y:.5g}} {unit_text(panel.unit)}{'' if panel.is_over_time else place}",
    )


def _band_trace(band: Band) -> go.Scatter:
    # Round the area: forth along the lower end, back along the upper one.
    low, high = thin(band.x, band.low), thin(band.x, band.high)[::-1]
    return go.Scatter(
        x=np.concatenate([band.x[low], band.x[high]]),
        y=np.concatenate([band.low[low], band.high[high]]),
        name=band.name,
        mode="lines",
        line=dict(width=0),
        fill="toself",
        fillcolor=band.ink,
        opacity=_PALE,
        hoverinfo="skip",
    )


def _marks_trace(marks: TimeMarks) -> go.Scatter:
    """Return the entry of the legend: lines across a panel have none."""
    style = dict(color=MUTED, width=1, dash=marks.dash)
    return go.Scatter(x=[None], y=[None], mode="lines", name=marks.name, line=style)
