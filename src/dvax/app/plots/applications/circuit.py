"""Pictures of a circuit: states, and currents of the diodes, over time."""

from collections.abc import Mapping

from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable

_PREFIXES = {"ms": 1e3, "µs": 1e6, "ns": 1e9}


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """Voltages, currents, and currents of the diodes."""
    seconds = data["time"].values
    unit, scale = next(((u, s) for u, s in _PREFIXES.items() if seconds[-1] * s >= 1.0), ("s", 1.0))
    if seconds[-1] >= 1.0:
        unit, scale = "s", 1.0
    t = seconds * scale
    panels = []
    for what, prefix, of in (
        ("voltage", "state_", "V"), ("current", "state_", "A"), ("diode current", "diode_", "A"),
    ):  # fmt: skip
        found = [n for n, v in data.items() if n.startswith(prefix) and v.unit == of]
        drawn = sum(len(panel.curves) for panel in panels)
        curves = [
            Curve(t, data[name].values, name.removeprefix(prefix), k, ("solid", "dash")[k // 6 % 2])
            for k, name in enumerate(found, start=drawn)
        ]
        if curves:
            panels.append(Panel(curves, what, of))
    return [
        panels_picture(
            "circuit", "The circuit over time",
            "Voltages of the capacitors, currents of the inductors and of the diodes.",
            panels, "time", unit,
        ),
    ]  # fmt: skip
