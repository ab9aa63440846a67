"""Pictures of a model that has none of its own: its variables over time, a panel for each unit and
each numbered name."""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from dvax.app.plots.field import field_pictures
from dvax.app.plots.panels import DASHES, Curve, Panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.section import Axis
from dvax.app.plots.store import Variable

_CURVES, _MOST_CURVES = 6, 12
"""So many series of one unit at most are drawn as curves."""


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """Long vectors as maps, series over time and short vectors as curves, other arrays by their
    smallest, mean and largest entries."""
    time = data["time"]
    t, unit = time.values, time.unit
    numbered = Counter((v.unit, _numbered(name)) for name, v in data.items() if v.values.ndim == 1)
    groups: dict[tuple[str, str], list[tuple[str, np.ndarray]]] = {}
    arrays: list[Panel] = []
    fields: list[tuple[str, np.ndarray, Axis]] = []
    for name, variable in data.items():
        values = variable.values
        if name in ("time", "error_bound") or len(values) != len(t):
            continue
        if values.ndim == 1:
            key = variable.unit, _numbered(name)
            # One name with a number is a name as others.
            key = key if numbered[key] > 1 else (variable.unit, "")
            groups.setdefault(key, []).append((name, values))
        elif values.ndim == 2 and values.shape[1] <= _CURVES:
            arrays.append(_entries(t, name, values, variable.unit))
        elif values.ndim == 2 and len(t) > 1:
            fields.append((name, values, Axis(name, variable.unit)))
        else:
            arrays.append(_extremes(t, name, values.reshape(len(t), -1), variable.unit))
    for (unit_of, word), series in list(groups.items()):
        if len(series) > _MOST_CURVES and len(t) > 1:
            names = [name for name, _ in groups.pop((unit_of, word))]
            values = np.stack([values for _, values in series], axis=1)
            fields.append((f"{names[0]} to {names[-1]}", values, Axis(word or "value", unit_of)))
    found: list[Picture] = []
    for k, (title, values, upward) in enumerate(fields):
        entry = Axis("entry", "")
        found += field_pictures(f"field-{k}", title, t, None, values, entry, upward, unit)
    panels = [*_panels(t, groups), *arrays]
    if panels:
        found.append(
            panels_picture(
                "histories", "States and responses over time",
                "Each variable of the model; those of one unit share a panel, and so do those of one "
                "name with numbers behind it.", panels, "time", unit,
            )
        )  # fmt: skip
    return found


def _entries(t: np.ndarray, name: str, values: np.ndarray, unit: str) -> Panel:
    curves = [Curve(t, column, f"{name}[{k}]", k, DASHES[0]) for k, column in enumerate(values.T)]
    return Panel(curves, name, unit)


def _extremes(t: np.ndarray, name: str, values: np.ndarray, unit: str) -> Panel:
    kinds = (("smallest", np.min), ("mean", np.mean), ("largest", np.max))
    curves = [
        Curve(t, of(values, axis=1), f"{name}, {kind}", k, DASHES[k])
        for k, (kind, of) in enumerate(kinds)
    ]
    return Panel(curves, name, unit)


def _numbered(name: str) -> str:
    """Return the name before the number of an entry: x of x0, x1, …; empty without a number."""
    word = name.rstrip("0123456789")
    return "" if word == name else word.rstrip("_ ")


def _panels(
    t: np.ndarray, groups: Mapping[tuple[str, str], list[tuple[str, np.ndarray]]]
) -> list[Panel]:
    panels, drawn = [], 0
    for (unit, word), series in groups.items():
        for begin in range(0, len(series), _CURVES):
            some = series[begin : begin + _CURVES]
            curves = [
                Curve(t, values, name, drawn + k, DASHES[(drawn + k) // _CURVES % len(DASHES)])
                for k, (name, values) in enumerate(some)
            ]
            drawn += len(some)
            words = some[0][0] if len(some) == 1 else word or "value"
            panels.append(Panel(curves, words, unit))
    return panels
