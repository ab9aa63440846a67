"""Pictures of a model that has none of its own: its variables over time, a panel a unit."""

from collections.abc import Mapping

import numpy as np

from dvax.app.plots.panels import Curve, Panel, bound_panel, bound_title, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable

_BOUND, _CURVES = "error_bound", 6
_DASHES = ("solid", "dash", "dot", "dashdot", "longdash")


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """Series over time by their units, arrays by their smallest, mean and largest entries, and the
    error bound."""
    time = data["time"]
    t, unit = time.values, time.unit
    by_unit: dict[str, list[tuple[str, np.ndarray]]] = {}
    fields: list[Panel] = []
    for name, variable in data.items():
        values = variable.values
        if name in ("time", _BOUND) or len(values) != len(t):
            continue
        if values.ndim == 1:
            by_unit.setdefault(variable.unit, []).append((name, values))
        else:
            flat = values.reshape(len(t), -1)
            kinds = (("smallest", np.min), ("mean", np.mean), ("largest", np.max))
            curves = [
                Curve(t, of(flat, axis=1), f"{name}, {kind}", k)
                for k, (kind, of) in enumerate(kinds)
            ]
            fields.append(Panel(curves, name, variable.unit))
    panels = [*_panels(t, by_unit), *fields]
    found = []
    if panels:
        found.append(
            panels_picture(
                "histories", "States and responses over time",
                "Each variable of the model; those of one unit share a panel.", panels, "time", unit,
            )
        )  # fmt: skip
    if _BOUND in data:
        bound = data[_BOUND]
        found.append(
            panels_picture(
                "certificate", bound_title(bound),
                "A bound on the distance of the computed state from the true one, in the norm of the "
                "state space.",
                [bound_panel(t, bound, bound.unit)], "time", unit,
            )
        )  # fmt: skip
    return found


def _panels(t: np.ndarray, by_unit: Mapping[str, list[tuple[str, np.ndarray]]]) -> list[Panel]:
    panels, drawn = [], 0
    for unit, series in by_unit.items():
        for begin in range(0, len(series), _CURVES):
            some = series[begin : begin + _CURVES]
            curves = [
                Curve(t, values, name, drawn + k, _DASHES[(drawn + k) // _CURVES % len(_DASHES)])
                for k, (name, values) in enumerate(some)
            ]
            drawn += len(some)
            words = some[0][0] if len(some) == 1 else "value"
            panels.append(Panel(curves, words, unit))
    return panels
