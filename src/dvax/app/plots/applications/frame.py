"""Pictures of a frame: ground, displacement, and hysteresis loops of the spring."""

from collections.abc import Mapping

from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """Histories and hysteresis."""
    t, d = data["time"].values, data["displacement"].values
    histories = [
        Panel([Curve(t, data["ground"].values, "ground", None)], "ground", "in/s^2", share=0.6),
        Panel(
            [Curve(t, d, "displacement", 0), Curve(t, data["plastic"].values, "plastic part", 1)],
            "displacement",
            "in",
        ),
    ]
    return [
        panels_picture(
            "histories", "Displacement under the earthquake",
            "The displacement of the mass against the ground, and what of it stays.",
            histories, "time", "s",
        ),
        panels_picture(
            "hysteresis", "Spring force over displacement",
            "An elastic frame stays on a line. The loops of one that yields are what it dissipates; "
            "beyond the yield force the viscosity bears the rest.",
            [Panel([Curve(d, data["spring"].values, "spring", 0)], "spring force a mass", "in/s^2")],
            "displacement", "in",
        ),
    ]  # fmt: skip
