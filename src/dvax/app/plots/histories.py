"""Histories at chosen points, beneath the load and the demand that drive them."""

import numpy as np

from dvax.app.plots.downsample import Reduced, blocks, edges
from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.theme import number, quantity, unit_text

DRIVERS = {"load_mean": "mean load ℓ", "demand_mean": "mean demand g"}
RESPONSES = {"pressure": "pressure p", "indentation": "indentation x"}


def histories_picture(run: RunRecord, reduced: Reduced) -> Picture:
    """Panels that share time: what drives the boundary above, the chosen points below."""
    points, why = _choose(run, reduced)
    panels = [
        Panel([Curve(run.time, run.series(name), words, None)], words, run.unit(name), share=0.6)
        for name, words in DRIVERS.items()
        if run.has(name)
    ]
    for name, words in RESPONSES.items():
        columns = _columns(run, name, points)
        curves = [
            Curve(run.time, columns[:, k], _place(run, point), k) for k, point in enumerate(points)
        ]
        panels.append(Panel(curves, words, run.unit(name)))
    caption = f"{why} Load and demand are averages over the boundary."
    kappa = run.attrs.get("kappa0")
    if kappa is not None:
        ends = edges(run.time)[[0, -1]]
        capacity = Curve(ends, np.full(2, kappa), "capacity κ₀", None, "dash")
        panels[-2].curves.append(capacity)
        shown = quantity(kappa, run.unit("pressure"))
        caption += f" The dashed line is the capacity κ₀ = {shown}."
    return panels_picture(
        "histories", "Histories at chosen points", caption, panels, "time", run.unit("time")
    )


def _choose(run: RunRecord, reduced: Reduced) -> tuple[list[int], str]:
    """Return the points that the configuration names, by default those of the highest, median and
    lowest mean pressure, and a sentence that says which."""
    asked = run.config.get("output", {}).get("points_of_interest") or []
    if asked:
        nearest = [_nearest(run, np.atleast_1d(np.asarray(place, float))) for place in asked]
        return list(
            dict.fromkeys(nearest)
        ), "The points nearest to those that the configuration names."
    order = np.argsort(reduced.time_mean, kind="stable")
    points = [int(order[-1]), int(order[len(order) // 2]), int(order[0])]
    why = "The points of the highest, the median and the lowest mean pressure."
    return list(dict.fromkeys(points)), why


def _coordinates(run: RunRecord) -> list[str]:
    return ["s"] if len(run.boundary_shape) == 1 else ["s1", "s2"]


def _nearest(run: RunRecord, place: np.ndarray) -> int:
    axes = [run.series(name) for name in _coordinates(run)]
    return int(np.argmin(sum((axis - value) ** 2 for axis, value in zip(axes, place, strict=True))))


def _place(run: RunRecord, point: int) -> str:
    parts = []
    for name in _coordinates(run):
        value = number(float(run.series(name)[point]), 6)
        parts.append(f"{name} = {value} {unit_text(run.unit(name))}".strip())
    return ", ".join(parts)


def _columns(run: RunRecord, name: str, points: list[int]) -> np.ndarray:
    """The histories of a field at `points`, shape (frames, points), read block by block."""
    parts = [run[name].frames(block)[:, points] for block in blocks(run)]
    return np.concatenate(parts).astype(float)
