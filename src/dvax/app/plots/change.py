"""A change of the data seen three ways, as one picture."""

import numpy as np
from matplotlib.figure import Figure

from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.sensitivity import Change

# field of a view: (legend, colour, dash)
_CURVES = {
    "actual": ("actual difference", 0, "solid"),
    "predicted": ("predicted to first order", 4, "dashdot"),
    "certified": ("certified (thm. on parameters)", 1, "dash"),
    "certified_sharp": ("certified, one-sided rate", 2, "dot"),
}


def change_figure(
    change: Change, *, time_unit: str = "", x_unit: str = "", u_unit: str = ""
) -> Figure:
    """‖Δx‖ above and ‖Δu‖ below over time, on logarithmic axes, with the bounds on them.

    **Arguments:** `change`, from `dvax.sensitivity.change`; the units for the axes.

    **Returns:** a matplotlib figure: `figure.savefig("change.png")`.
    """
    panels = []
    for words, views, unit in (("‖Δx‖", change.x, x_unit), ("‖Δu‖", change.u, u_unit)):
        curves = [
            Curve(np.asarray(change.ts), np.asarray(values), *style)
            for name, style in _CURVES.items()
            if (values := getattr(views, name)) is not None
        ]
        panels.append(Panel(curves, words, unit, log=True))
    title = f"A change of the data: certified bounds are {change.status}"
    return panels_picture("change", title, "", panels, "time", time_unit).still()
