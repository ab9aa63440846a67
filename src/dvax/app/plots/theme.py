"""The theme of all pictures: colours that colour-blind readers can distinguish, numbers and units
as text."""

import math
import re
from typing import Any

import plotly.graph_objects as go
from matplotlib.figure import Figure
from plotly.subplots import make_subplots

from dvax._figure_text import NOT_FINITE

# Six colours for curves. On white they have a contrast of at least 3, and each two of them differ for
# every kind of colour vision (tests/app/plots/test_colours.py). The first two are of Okabe and Ito.
BLUE, VERMILLION, GREEN, PURPLE, BROWN, NAVY = SERIES = (
    "#0072B2",
    "#D55E00",
    "#2CA57A",
    "#D953F6",
    "#8A461B",
    "#10496B",
)
INK, MUTED, RULE, SURFACE = "#1F2933", "#5F6B76", "#DDE3E8", "#FFFFFF"
# Pale to strong: the order of the regimes survives a grey print and every kind of colour blindness.
REGIME_COLOURS = ("#F3F0E6", "#3F8ABF", "#682300")
# What each colour of a figure is on a dark page.
DARK = {
    INK: "#E6EAEE",
    MUTED: "#A3AFBA",
    RULE: "#303A43",
    SURFACE: "#171C21",
    **dict(
        zip(SERIES, ("#52AEFC", "#EE7289", "#96FFED", "#5B6EE0", "#F3CD27", "#A26211"), strict=True)
    ),
    **dict(zip(REGIME_COLOURS, ("#2B333B", "#338FCD", "#FDECD2"), strict=True)),
}
# Colours of the page, on a light and on a dark one; page.css has them as variables.
PAGE_COLOURS = {
    "ink": (INK, DARK[INK]),
    "muted": (MUTED, DARK[MUTED]),
    "rule": (RULE, DARK[RULE]),
    "surface": (SURFACE, DARK[SURFACE]),
    "page": ("#F5F7F9", "#0F1317"),
    "accent": (BLUE, DARK[BLUE]),
    "on-accent": ("#FFFFFF", "#0F1317"),
    "border": ("#7D8994", "#6D7883"),
    "notice": ("#B26A00", "#F3CD27"),
    "alarm": ("#C24A00", "#FF8A5C"),
    "proved": ("#D3ECE3", "#10402F"),
    "declared": ("#D9E9F5", "#12395A"),
    "estimated": ("#FBE9C6", "#4A3705"),
    "refuted": ("#F7D9C8", "#5A2410"),
}
PRESSURE_MAP = "viridis"
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"

_SUPERSCRIPT = str.maketrans("-0123456789.", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹·")


def number(value: Any, digits: int = 4) -> str:
    """Return a number as text: `digits` significant ones, powers of ten written out."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return NOT_FINITE.get(str(value), str(value))
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    if not math.isfinite(value):
        return NOT_FINITE[str(float(value))]
    value += 0.0  # no negative zero
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{float(mantissa):g} × 10{str(int(exponent)).translate(_SUPERSCRIPT)}"


def unit_text(unit: str) -> str:
    """Return a unit as text: um as µm, powers as superscripts."""
    if unit in ("", "1", "dimensionless"):
        return ""
    text = re.sub(r"\bum\b", "µm", unit).replace("^(1/2)", "^0.5")
    text = re.sub(r"(?:\*\*|\^)\(?(-?[0-9.]+)\)?", lambda m: m[1].translate(_SUPERSCRIPT), text)
    return re.sub(r"\s*\*\s*", " ", text)


def counted(count: int, noun: str) -> str:
    """A count with its noun: 1 frame, 2 frames."""
    return f"{number(count)} {noun}" + "s" * (count != 1)


def quantity(value: Any, unit: str) -> str:
    """A number with its unit; no trailing space where there is none."""
    return f"{number(value)} {unit_text(unit)}".strip()


def axis_title(words: str, unit: str) -> str:
    """`words [unit]`, or the words alone for a pure number."""
    return f"{words} [{unit_text(unit)}]" if unit_text(unit) else words


def _axis() -> dict[str, Any]:
    return dict(
        showline=True,
        linecolor=MUTED,
        gridcolor=RULE,
        zeroline=False,
        ticks="outside",
        tickcolor=MUTED,
        automargin=True,
        title=dict(standoff=8, font=dict(size=13)),
    )


# Built once at import: Plotly loads the parts of a layout at their first use.
_TEMPLATE = go.layout.Template(layout=dict(xaxis=_axis(), yaxis=_axis()))


def blank(height: int, row_heights: tuple[float, ...] = (1.0,)) -> go.Figure:
    """Return an empty interactive figure in the theme; its title stands in the page, above it.

    Several `row_heights` make panels one above the other that share the horizontal axis.
    """
    layout = go.Layout(
        template=_TEMPLATE,
        height=height,
        font=dict(family=FONT, size=13, color=INK),
        paper_bgcolor=SURFACE,
        plot_bgcolor=SURFACE,
        margin=dict(l=56, r=16, t=16, b=44),
        hoverlabel=dict(
            font=dict(family=FONT, color=INK), bgcolor=SURFACE, bordercolor=MUTED, namelength=-1
        ),
        legend=dict(
            traceorder="normal", orientation="h", x=0, y=1.01, xanchor="left", yanchor="bottom"
        ),
    )
    return make_subplots(
        rows=len(row_heights),
        cols=1,
        shared_xaxes=True,
        row_heights=list(row_heights),
        vertical_spacing=0.05,
        # Given a template, Plotly does not read and check its own.
        figure=go.Figure(layout=layout),
    )


def pressure_bar(figure: go.Figure, words: str, height: int) -> dict[str, Any]:
    """A flat colour bar for the top margin of `figure`, `height` pixels tall; widens that margin.

    It is placed against the container: placed against the panel it moves the margin after the axis
    title has been placed, and the title ends up on the tick labels (Plotly.js 4.1).
    """
    title = dict(text=words, font=dict(size=13), x=0, xref="paper", y=1, yref="container")
    figure.update_layout(
        margin=dict(t=78), title=dict(**title, yanchor="top", pad=dict(t=4), automargin=False)
    )
    return dict(
        orientation="h",
        yref="container",
        y=1 - 24 / height,
        yanchor="top",
        thickness=12,
        len=1.0,
        ypad=4,
    )


# The same theme for still pictures.
STILL_STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.grid": True,
    "grid.color": RULE,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "legend.frameon": False,
    "figure.dpi": 150,
    "savefig.dpi": 150,
}


def still_axes(
    rows: int = 1, columns: int = 1, *, figsize: tuple[float, float], **options: Any
) -> tuple[Figure, Any]:
    """A still figure and its axes, as `matplotlib.pyplot.subplots` gives them.

    Without pyplot there is no global state to close and no window system to load.
    """
    figure = Figure(figsize=figsize, layout="constrained")
    return figure, figure.subplots(rows, columns, **options)
