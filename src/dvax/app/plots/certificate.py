"""The certified error against time: of the trajectory (x and u), and of the frozen law."""

import math

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.figure import Figure

from dvax._figure_text import entry_text
from dvax.app.plots.lines import LARGEST, positive, thin
from dvax.app.plots.picture import Picture
from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.theme import (
    BLUE,
    GREEN,
    MUTED,
    SKY,
    STILL_STYLE,
    VERMILLION,
    axis_title,
    blank,
    number,
    still_axes,
    unit_text,
)

# name: (legend, colour, plotly dash, matplotlib line style)
CURVES = {
    "error_bound_x": ("bound on the error of x", BLUE, "solid", "-"),
    "error_bound_u": ("bound on the error of u", VERMILLION, "dash", "--"),
    "error_bound_sharp_x": ("the same for x, one-sided rate", SKY, "longdash", (0, (8, 3))),
    "law_error": ("error of the frozen law, u", GREEN, "dot", ":"),
    "defect": ("accumulated defect", MUTED, "dashdot", "-."),
}


def certificate_picture(run: RunRecord) -> Picture | None:
    """The curves that the run holds, on a logarithmic axis; None where it holds none."""
    held = [name for name in CURVES if run.has(name)]
    if not held:
        return None
    units = {name: run.unit(name) for name in held}
    shared = units[held[0]] if len(set(units.values())) == 1 else ""
    names = {name: _legend(run, name, with_unit=not shared) for name in held}
    words = axis_title("error bound", shared)
    figure = blank(440)
    for name in held:
        values = positive(run.series(name))
        shown = thin(run.time, values)
        figure.add_trace(
            go.Scatter(
                x=run.time[shown],
                y=values[shown],
                name=names[name],
                mode="lines" if len(shown) > 1 else "markers",
                line=dict(color=CURVES[name][1], dash=CURVES[name][2], width=2),
                hovertemplate=f"%{{y:.3g}} {units[name]} at %{{x:.4g}} {run.unit('time')}",
            )
        )
    figure.update_xaxes(title_text=axis_title("time", run.unit("time")))
    figure.update_yaxes(
        title_text=words, type="log", exponentformat="power", dtick=_decades(run, held)
    )

    def still() -> Figure:
        with rc_context(STILL_STYLE):
            drawn, axes = still_axes(figsize=(8, 4.6))
            for name in held:
                _, colour, _, style = CURVES[name]
                marker = "o" if len(run.time) == 1 else ""
                axes.plot(
                    run.time,
                    positive(run.series(name)),
                    color=colour,
                    linestyle=style,
                    marker=marker,
                    label=names[name],
                )
            axes.set(yscale="log", xlabel=axis_title("time", run.unit("time")), ylabel=words)
            # Above the legend, however many rows it has.
            axes.set_title(_title(run, held), pad=8 + 16 * math.ceil(len(held) / 2))
            axes.legend(
                ncols=2, loc="lower left", bbox_to_anchor=(0, 1.0), fontsize=9, borderpad=0.2
            )
        return drawn

    return Picture(
        key="certificate",
        title=_title(run, held),
        caption=_caption(run, held),
        interactive=figure,
        still=still,
    )


def _title(run: RunRecord, held: list[str]) -> str:
    """Nothing is called certified but what is proved."""
    known = {str(run.frames.about(name).get("status", "")) for name in held} - {"", "proved"}
    return f"Error bound against time, {known.pop()}" if known else "Certified error against time"


def _legend(run: RunRecord, name: str, *, with_unit: bool) -> str:
    status = str(run.frames.about(name).get("status", ""))
    status = f" ({status})" if status else ""
    unit = f" [{run.unit(name)}]" if with_unit and run.unit(name) else ""
    return CURVES[name][0] + status + unit


def _decades(run: RunRecord, held: list[str]) -> int:
    """Whole decades between ticks, at most about eight of them: 2 × 10⁻⁷ is no landmark."""
    values = np.concatenate([positive(run.series(name)) for name in held])
    if not np.isfinite(values).any():
        return 1
    span = np.log10(np.nanmax(values)) - np.log10(np.nanmin(values))
    return max(1, int(np.ceil(span / 8)))


def _caption(run: RunRecord, held: list[str]) -> str:
    parts = [
        "The exact solution at the points of the boundary lies no farther than this from the "
        "computed one, in the norm of the boundary and up to floating-point rounding, provided "
        "that the constants hold on which the bound rests: proved, declared and estimated are "
        "different words."
    ]
    for name in ("error_bound_x", "error_bound_u"):
        if name in held:
            value = float(run.series(name)[-1])
            what = "x" if name.endswith("x") else "u"
            shown = entry_text({"value": value, "bound": True})
            parts.append(f"At the last frame, for {what}: {shown} {unit_text(run.unit(name))}.")
    if any((run.series(name) <= 0).any() for name in held):
        parts.append(
            "Zero (exact at a frame, such as the given initial state) has no place on a "
            "logarithmic axis and is left as a gap."
        )
    if any(not (run.series(name) <= LARGEST).all() for name in held):
        parts.append(
            f"Where a bound is not finite, or above {number(LARGEST)}, the certificate says nothing, "
            "and the curve has a gap."
        )
    return " ".join(parts)
