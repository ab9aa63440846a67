"""The certified error against time: of the trajectory (x and u), and of the frozen law."""

import numpy as np

from dvax._figure_text import entry_text
from dvax.app.plots.lines import LARGEST
from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.theme import number, unit_text

# variable: (legend, colour, dash)
CURVES = {
    "error_bound_x": ("bound on the error of x", 0, "solid"),
    "error_bound_u": ("bound on the error of u", 1, "dash"),
    "error_bound_sharp_x": ("the same for x, one-sided rate", 5, "longdash"),
    "law_error": ("error of the frozen law, u", 2, "dot"),
    "defect": ("accumulated defect", None, "dashdot"),
}


def certificate_picture(run: RunRecord) -> Picture | None:
    """The curves that the run holds, on a logarithmic axis; None where it holds none."""
    held = [name for name in CURVES if run.has(name)]
    if not held:
        return None
    units = {run.unit(name) for name in held}
    shared = units.pop() if len(units) == 1 else ""
    curves = []
    for name in held:
        legend, colour, dash = CURVES[name]
        status = f" ({run[name].status})" if run[name].status else ""
        unit = f" [{run.unit(name)}]" if run.unit(name) and not shared else ""
        curves.append(Curve(run.time, run.series(name), legend + status + unit, colour, dash))
    weak = {run[name].status for name in held} - {"", "proved"}
    # Only proved bounds are called certified.
    title = f"Error bound against time, {max(weak)}" if weak else "Certified error against time"
    return panels_picture(
        "certificate", title, _caption(run, held), [Panel(curves, "error bound", shared, log=True)],
        "time", run.unit("time"),
    )  # fmt: skip


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
    values = np.concatenate([run.series(name) for name in held])
    if (values <= 0).any():
        parts.append(
            "Zero (exact at a frame, such as the given initial state) has no place on a "
            "logarithmic axis and is left as a gap."
        )
    if not (values <= LARGEST).all():
        parts.append(
            f"Where a bound is not finite, or above {number(LARGEST)}, the certificate says nothing, "
            "and the curve has a gap."
        )
    return " ".join(parts)
