"""Two trajectories from different initial states, against the certified decay between them.

Paper, cor:incremental_stability: ‖x₁(t) − x₂(t)‖ ≤ M e^{−(η − M L̃)t} ‖x₀₁ − x₀₂‖, and L times this
for u. The sharp bound uses the one-sided rate, which knows the sign of −d_x x.
"""

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.figure import Figure

from dvax.app.plots.lines import positive, thin
from dvax.app.plots.picture import Picture
from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.theme import (
    BLUE,
    GREEN,
    STILL_STYLE,
    VERMILLION,
    axis_title,
    blank,
    number,
    still_axes,
    unit_text,
)

# Differences of numbers of size one lose all digits here.
ROUNDING = 1e-13
OBSERVED, CERTIFIED, SHARP = "observed", "certified, e^(−(η−ML̃)t)", "sharper, one-sided rate"
# panel: (quantity, ((variable, legend, colour, plotly dash, matplotlib style), ...))
PANELS = (
    (
        "‖x₁ − x₂‖",
        (
            ("separation_x", OBSERVED, BLUE, "solid", "-"),
            ("separation_bound_x", CERTIFIED, VERMILLION, "dash", "--"),
            ("separation_sharp_x", SHARP, GREEN, "dot", ":"),
        ),
    ),
    (
        "‖u₁ − u₂‖",
        (
            ("separation_u", OBSERVED, BLUE, "solid", "-"),
            ("separation_bound_u", CERTIFIED, VERMILLION, "dash", "--"),
        ),
    ),
)


def separation_picture(run: RunRecord) -> Picture | None:
    """x above, u below, both logarithmic; None where the run had no companion trajectory."""
    panels = [panel for panel in PANELS if run.has(panel[1][0][0])]
    if not panels:
        return None
    figure = blank(300 * len(panels), (1.0,) * len(panels))
    for row, (words, curves) in enumerate(panels, start=1):
        for name, legend, colour, dash, _ in curves:
            if not run.has(name):
                continue
            values = positive(run.series(name))
            shown = thin(run.time, values)
            figure.add_trace(
                go.Scatter(
                    x=run.time[shown],
                    y=values[shown],
                    name=legend,
                    legendgroup=legend,
                    showlegend=row == 1,
                    mode="lines" if len(shown) > 1 else "markers",
                    line=dict(color=colour, dash=dash, width=2),
                    hovertemplate=(
                        f"%{{y:.3g}} {unit_text(run.unit(name))} "
                        f"at %{{x:.4g}} {unit_text(run.unit('time'))}"
                    ),
                ),
                row=row,
                col=1,
            )
        figure.update_yaxes(
            title_text=axis_title(words, run.unit(curves[0][0])),
            type="log",
            exponentformat="power",
            row=row,
            col=1,
        )
    figure.update_xaxes(title_text=axis_title("time", run.unit("time")), row=len(panels), col=1)
    return Picture(
        key="separation",
        title="Two trajectories against the certified decay",
        caption=_caption(run),
        interactive=figure,
        still=lambda: _still(run, panels),
    )


def _still(run: RunRecord, panels: list) -> Figure:
    with rc_context(STILL_STYLE):
        drawn, grid = still_axes(
            len(panels),
            1,
            figsize=(8, 3.2 * len(panels)),
            sharex=True,
            squeeze=False,
        )
        for axes, (words, curves) in zip(grid[:, 0], panels, strict=True):
            for name, legend, colour, _, style in curves:
                if run.has(name):
                    marker = "o" if len(run.time) == 1 else ""
                    values = positive(run.series(name))
                    axes.plot(
                        run.time, values, color=colour, linestyle=style, marker=marker, label=legend
                    )
            axes.set(yscale="log", ylabel=axis_title(words, run.unit(curves[0][0])))
        grid[0, 0].set_title("Two trajectories against the certified decay", pad=28)
        grid[0, 0].legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0), borderpad=0.2)
        grid[-1, 0].set_xlabel(axis_title("time", run.unit("time")))
    return drawn


def _reaches_rounding(separation: np.ndarray) -> bool:
    return bool((separation[1:] < ROUNDING * separation[0]).any())


def _caption(run: RunRecord) -> str:
    parts = [
        "A second trajectory starts from a perturbed initial state. The certified decay is the "
        "paper's (cor:incremental_stability); it uses |d_x| and not its sign, so it is "
        "conservative. The sharper curve uses the one-sided (logarithmic-norm) rate."
    ]
    names = [name for _, curves in PANELS for name, *_ in curves if run.has(name)]
    if run.has("separation_bound_x"):
        observed, bound = run.series("separation_x"), run.series("separation_bound_x")
        tells = (bound > 0) & np.isfinite(bound)
        tight = observed[tells] / bound[tells]
        if tight.size:
            parts.append(
                "The largest ratio of the observed to the certified separation of x is "
                f"{number(float(tight.max()), 3)}."
            )
    if any(_reaches_rounding(run.series(name)) for name in names if name.endswith(("n_x", "n_u"))):
        parts.append(
            f"Where it has fallen below {number(ROUNDING)} of its first value, what is observed is "
            "floating-point rounding, which no bound covers."
        )
    if any((run.series(name) <= 0).any() for name in names):
        parts.append("A separation of exactly zero is left as a gap.")
    return " ".join(parts)
