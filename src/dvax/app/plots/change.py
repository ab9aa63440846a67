"""A change of the data seen three ways, as one picture."""

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from dvax.app.plots.lines import positive
from dvax.app.plots.theme import (
    BLUE,
    GREEN,
    ORANGE,
    STILL_STYLE,
    VERMILLION,
    axis_title,
    still_axes,
)
from dvax.sensitivity import Change
from dvax.sensitivity.change import Views

_CURVES = (
    ("actual", "actual difference", BLUE, "-"),
    ("predicted", "predicted to first order", ORANGE, "-."),
    ("certified", "certified (thm. on parameters)", VERMILLION, "--"),
    ("certified_sharp", "certified, one-sided rate", GREEN, ":"),
)


def change_figure(
    change: Change, *, time_unit: str = "", x_unit: str = "", u_unit: str = ""
) -> Figure:
    """‖Δx‖ above and ‖Δu‖ below over time, on logarithmic axes, with the bounds on them.

    **Arguments:** `change`, from `dvax.sensitivity.change`; the units for the axes.

    **Returns:** a matplotlib figure: `figure.savefig("change.png")`.
    """
    with rc_context(STILL_STYLE):
        figure, panels = still_axes(2, 1, figsize=(7.0, 5.6), sharex=True)
        for axes, words, views, unit in zip(
            panels, ("‖Δx‖", "‖Δu‖"), (change.x, change.u), (x_unit, u_unit), strict=True
        ):
            _panel(axes, change.ts, views)
            axes.set_ylabel(axis_title(words, unit))
        panels[-1].set_xlabel(axis_title("time", time_unit))
        panels[0].legend(loc="lower right", frameon=False)
        figure.suptitle(f"A change of the data: certified bounds are {change.status}")
    return figure


def _panel(axes, ts: np.ndarray, views: Views) -> None:
    for name, label, colour, style in _CURVES:
        values = getattr(views, name)
        if values is not None:
            axes.plot(ts, positive(values), style, color=colour, label=label, linewidth=1.8)
    axes.set_yscale("log")
