"""Pictures of a viscoplastic point: stress over strain, the yield limit, and histories."""

from collections.abc import Mapping

import numpy as np

from dvax.app.plots.panels import Curve, Panel, bound_panel, bound_title, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable

_DASHES = ("solid", "dash", "dot")
"""Components that are equal stay visible."""


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """Stress–strain curves, the path against the yield surface, histories, and the error bound."""
    t, unit = data["time"].values, data["time"].unit
    moved = [n.removeprefix("strain_") for n in data if n.startswith("strain_")]
    loops = [
        Curve(
            100 * data[f"strain_{c}"].values,
            data[f"stress_{c}"].values,
            f"component {c}",
            k,
            _DASHES[k % 3],
        )
        for k, c in enumerate(moved)
        if f"stress_{c}" in data
    ]
    strains = [
        Curve(t, 100 * data[f"strain_{c}"].values, f"component {c}", k) for k, c in enumerate(moved)
    ]
    q, limit, p = (data[n].values for n in ("equivalent_stress", "yield_limit", "pressure"))
    plastic = Curve(t, 100 * data["equivalent_plastic_strain"].values, "plastic strain", 4)
    limits = Curve(t, limit, "yield limit", None, "dash")
    order = np.argsort(p)
    surface = Curve(p[order], limit[order], "yield surface", None, "dash")
    bound = data["error_bound"]
    words = "equivalent stress"
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
        panels_picture(
            "yield_surface", "The stress path and the yield surface",
            "The surface over pressure and equivalent stress, √(3/2)‖dev σ‖; above it is overstress.",
            [Panel([Curve(p, q, "stress path", 3), surface], words, "MPa", share=1.6)],
            "pressure", "MPa",
        ),
        panels_picture(
            "certificate", bound_title(bound),
            "A bound on the error of the plastic strain, in the norm of the elastic energy.",
            [bound_panel(t, bound, bound.unit)], "time", unit,
        ),
    ]  # fmt: skip
