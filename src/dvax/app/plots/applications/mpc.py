"""Pictures of predictive control: states and their references, inputs and their limits."""

from collections.abc import Mapping

from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable

_REFERENCE, _INPUT = "reference_", "input_"


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """States in a panel a unit, and inputs each in its own."""
    t = data["time"].values
    states = [n.removeprefix(_REFERENCE) for n in data if n.startswith(_REFERENCE)]
    inputs = [n.removeprefix("input_max_") for n in data if n.startswith("input_max_")]
    by_unit: dict[str, list[str]] = {}
    for name in states:
        by_unit.setdefault(data[name].unit, []).append(name)
    panels = []
    for unit, names in by_unit.items():
        curves = []
        for name in names:
            wanted = data[_REFERENCE + name].values
            colour = None if len(names) == 1 else states.index(name)
            curves.append(Curve(t, wanted, f"{name}, reference", colour, "dash"))
            curves.append(Curve(t, data[name].values, name, states.index(name)))
        panels.append(Panel(curves, names[0] if len(names) == 1 else "states", unit))
    for k, name in enumerate(inputs):
        limits = [
            Curve(t, data[f"input_{end}_{name}"].values, "limits of the inputs", None, "dot")
            for end in ("min", "max")
        ]
        own = Curve(t, data[_INPUT + name].values, name, len(states) + k)
        panels.append(Panel([*limits, own], name, data[_INPUT + name].unit))
    return [
        panels_picture(
            "mpc", "The plant under predictive control",
            "The controller plans over its horizon at every time and applies the first input of the "
            "plan. Where an input is at a limit the plant cannot follow faster.",
            panels, "time", data["time"].unit,
        ),
    ]  # fmt: skip
