"""Pictures of a viscoplastic point: stress over strain, the yield surface, and histories."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable

_DASHES = ("solid", "dash", "dot")
"""Components that are equal stay visible."""


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """Stress–strain curves, the path against the yield surface, and histories."""
    t, unit = data["time"].values, data["time"].unit
    moved = [n.removeprefix("strain_") for n in data if n.startswith("strain_")]
    loops, strains = [], []
    for k, c in enumerate(moved):
        strain, style = 100 * data[f"strain_{c}"].values, (f"component {c}", k, _DASHES[k % 3])
        strains.append(Curve(t, strain, *style))
        loops.append(Curve(strain, data[f"stress_{c}"].values, *style))
    q, limit = (data[n].values for n in ("equivalent_stress", "yield_limit"))
    words = "equivalent stress"
    plastic = Curve(t, 100 * data["equivalent_plastic_strain"].values, "plastic strain", 4)
    limits = Curve(t, limit, "yield limit", None, "dash")
    return [
        panels_picture(
            "stress_strain", "Stress over strain",
            "Slopes are elastic inside the yield surface. Beyond it the stress relaxes towards the "
            "surface, so that faster paths have higher stress.",
            [Panel(loops, "stress", "MPa", share=1.6)], "strain", "%",
        ),
        panels_picture(
            "histories", "The strain path and the response",
            "Where the equivalent stress is above the yield limit the plastic strain changes.",
            [
                Panel(strains, "strain", "%", share=0.8),
                Panel([Curve(t, q, words, 3), limits], words, "MPa"),
                Panel([plastic], "equivalent<br>plastic strain", "%", share=0.8),
            ],
            "time", unit,
        ),
        _cylinder(data) if np.ptp(limit) == 0.0 else _cone(data),
    ]  # fmt: skip


def _cylinder(data: Mapping[str, Variable]) -> Picture:
    """The path in the plane of its two main deviatoric directions, where the surface is a circle."""
    deviator = np.zeros((len(data["time"].values), 3, 3))
    for name, variable in data.items():
        if name.startswith("stress_"):
            i, j = int(name[-2]) - 1, int(name[-1]) - 1
            deviator[:, i, j] = deviator[:, j, i] = variable.values
    deviator -= np.trace(deviator, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3
    rows = deviator.reshape(-1, 9)
    along = rows @ np.linalg.svd(rows, full_matrices=False)[2][:2].T
    radius = np.sqrt(2 / 3) * data["yield_limit"].values[0]
    angle = np.linspace(0.0, 2 * np.pi, 200)
    circle = Curve(radius * np.cos(angle), radius * np.sin(angle), "yield surface", None, "dash")
    path = Curve(along[:, 0], along[:, 1], "stress path", 3)
    picture = panels_picture(
        "yield_surface", "The stress path and the yield surface",
        "The plane of the two largest directions of the deviatoric stress. The yield surface is a "
        "circle in it; the distance to the circle is the overstress.",
        [Panel([path, circle], "second direction", "MPa", share=2.0)],
        "deviatoric stress, first direction", "MPa",
    )  # fmt: skip
    picture.interactive.update_xaxes(constrain="domain")
    picture.interactive.update_yaxes(scaleanchor="x", constrain="domain")
    drawing = picture.still

    def still() -> Figure:
        drawn = drawing()
        drawn.set_size_inches(6.4, 6.6)
        drawn.axes[0].set_aspect("equal")
        return drawn

    return replace(picture, still=still)


def _cone(data: Mapping[str, Variable]) -> Picture:
    """The path over pressure and equivalent stress, where the surface is a line."""
    p, q, limit = (data[n].values for n in ("pressure", "equivalent_stress", "yield_limit"))
    order = np.argsort(p)
    surface = Curve(p[order], limit[order], "yield surface", None, "dash")
    return panels_picture(
        "yield_surface", "The stress path and the yield surface",
        "The surface over pressure and equivalent stress, √(3/2)‖dev σ‖; above it is overstress.",
        [Panel([Curve(p, q, "stress path", 3), surface], "equivalent stress", "MPa", share=1.6)],
        "pressure", "MPa",
    )  # fmt: skip
