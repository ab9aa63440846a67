"""Drawings of a contact law: maps over space and time, a profile, the force, and the certificate."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from dvax.app.explore.drawing import POWERS, PREDICTED, layout, line, single
from dvax.app.explore.subject import AbstractFrames, Drawing
from dvax.app.plots.downsample import REGIMES, SPACE_CELLS, TIME_CELLS, edges, starts
from dvax.app.plots.lines import positive
from dvax.app.plots.maps import REGIME_SCALE
from dvax.app.plots.picture import Views
from dvax.app.plots.theme import (
    MUTED,
    PRESSURE_MAP,
    SERIES,
    axis_title,
    quantity,
    unit_text,
)
from dvax.app.runs.boundary import Boundary
from dvax.app.runs.units import Units

REGIME_WORDS = "0 unloaded, 1 active, 2 saturated"


@dataclass(frozen=True)
class Fields:
    """A solution of the contact law: `pressure` and `regime` (times, points), error bounds of x and u
    (times,) with their `status` and their unit `norm`."""

    times: np.ndarray
    boundary: Boundary
    units: Units
    kappa0: float
    pressure: np.ndarray
    regime: np.ndarray
    bound_x: np.ndarray
    bound_u: np.ndarray
    status: str
    norm: str


@dataclass(frozen=True)
class Prediction:
    """The pressure that a derivative predicts, its name in a legend, and a sentence on it."""

    pressure: np.ndarray
    name: str
    sentence: str


def drawings(fields: Fields, prediction: Prediction | None) -> list[Drawing]:
    """Return the drawings that show all times."""
    maps = [_map(fields)] if len(fields.boundary.names) == 1 else []
    return [*maps, _force(fields, prediction), _bounds(fields)]


class ContactFrames(AbstractFrames):
    """The profile of the pressure at a saved time; on a surface, its map."""

    def __init__(self, fields: Fields, prediction: Prediction | None):
        self._fields, self._prediction = fields, prediction
        self.times, self.unit = fields.times, fields.units.time

    def draw(self, frame: int) -> list[Drawing]:
        f, at = self._fields, quantity(float(self.times[frame]), self.unit)
        if len(f.boundary.names) == 1:
            return [self._profile(frame, at)]
        return [self._surface(frame, at)]

    def _profile(self, frame: int, at: str) -> Drawing:
        f, s = self._fields, self._fields.boundary.coordinates[0]
        place, unit = unit_text(f.units.length), unit_text(f.units.pressure)
        hover = f"%{{y:.4g}} {unit} at %{{x:.4g}} {place}"
        data: list[Any] = [
            {
                "type": "heatmap", "x": single(edges(s)), "y": [0.0, 1.0], "yaxis": "y2",
                "z": f.regime[frame][None, :].astype(np.int8), "zmin": -0.5, "zmax": 2.5,
                "colorscale": REGIME_SCALE, "showscale": False, "name": "regime",
                "hovertemplate": f"regime %{{z}} ({REGIME_WORDS})<extra></extra>",
            },
            line(s[[0, -1]], np.full(2, f.kappa0), "capacity κ₀", MUTED, "dot", hoverinfo="skip"),
            line(s, f.pressure[frame], "pressure", SERIES[0], hovertemplate=hover),
        ]  # fmt: skip
        if self._prediction is not None:
            predicted = self._prediction
            data.append(
                line(
                    s, predicted.pressure[frame], predicted.name, PREDICTED, "dash",
                    hovertemplate=hover,
                )
            )  # fmt: skip
        return Drawing(
            "profile",
            f"Pressure along the boundary at t = {at}",
            "The strip below the curve shows the regimes: unloaded (pale), active (blue: contact below "
            "the capacity) and saturated (brown: the pressure is at κ₀).",
            data,
            layout(
                380, ("place on the boundary", f.units.length), ("pressure", f.units.pressure),
                yaxis={"domain": [0.1, 1.0], "rangemode": "tozero", "range": self._range()},
                yaxis2={
                    "domain": [0.0, 0.05], "showticklabels": False, "ticks": "", "showgrid": False,
                    "fixedrange": True, "anchor": "x",
                },
                xaxis={"anchor": "y2"},
            ),
        )  # fmt: skip

    def _range(self) -> list[float]:
        """One range for all times: a scale that changes with the time misleads."""
        top = max(float(self._fields.pressure.max()), 0.05 * self._fields.kappa0)
        return [-0.03 * top, 1.15 * top]

    def _surface(self, frame: int, at: str) -> Drawing:
        f = self._fields
        shape, (first, second) = f.boundary.shape, f.boundary.coordinates
        lines = first.reshape(shape)[:, 0], second.reshape(shape)[0]
        views = Views("Show the", ("pressure", "regimes"))
        return Drawing(
            "profile",
            f"Pressure over the boundary at t = {at}",
            f"Regimes: {REGIME_WORDS}.",
            _heat_maps(
                (edges(lines[0]), edges(lines[1])), f.pressure[frame].reshape(shape).T,
                f.regime[frame].reshape(shape).T, f, float(f.pressure.max()),
            ),
            layout(
                460, ("s1", f.units.length), ("s2", f.units.length),
                yaxis={"scaleanchor": "x", "constrain": "domain"}, xaxis={"constrain": "domain"},
            ),
            views,
        )  # fmt: skip


def _map(f: Fields) -> Drawing:
    time, place = f.units.time, f.units.length
    begin, low = starts(len(f.times), TIME_CELLS), _groups(f.boundary.size)
    weights = f.boundary.weights
    counts = np.diff([*begin, len(f.times)])[:, None]
    whole = counts * np.add.reduceat(weights, low)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = np.add.reduceat(values * weights, low, axis=1)
        # Along the first axis this is slow, and few runs have so many times.
        return (sums if len(begin) == len(sums) else np.add.reduceat(sums, begin)) / whole

    shares = [mean(f.regime == kind) for kind in range(len(REGIMES))]
    common = np.argmax(shares, axis=0)
    across = edges(f.times)[[*begin, len(f.times)]]
    upward = edges(f.boundary.coordinates[0])[[*low, f.boundary.size]]
    cells = "" if whole.shape == f.pressure.shape else (
        " A cell of the picture shows the mean pressure and the most common regime of its points."
    )  # fmt: skip
    return Drawing(
        "pressure",
        "Pressure and regimes over space and time",
        f"The line is at the time of the profile; click in the map to move it.{cells}",
        _heat_maps((across, upward), mean(f.pressure).T, common.T, f, float(f.pressure.max())),
        layout(
            400, ("time", time), ("place on the boundary", place),
            xaxis={"showgrid": False}, yaxis={"showgrid": False},
        ),
        Views("Show the", ("pressure", "regimes")),
        has_time=True,
    )  # fmt: skip


def _groups(points: int) -> np.ndarray:
    """Return the first point of each cell: cells of equally many points where there are such, since a
    browser draws a map of equal cells several times as fast."""
    least = -(-points // SPACE_CELLS)
    size = next((n for n in range(least, 2 * least + 1) if points % n == 0), None)
    return starts(points, SPACE_CELLS) if size is None else np.arange(0, points, size)


def _is_even(line: np.ndarray) -> bool:
    widths = np.diff(line)
    return bool(np.allclose(widths, widths.mean(), rtol=1e-6))


def _heat_maps(
    cells: tuple[np.ndarray, np.ndarray], pressure: np.ndarray, regime: np.ndarray, f: Fields,
    top: float,
) -> list[Any]:  # fmt: skip
    x, y = map(single, cells)
    unit = unit_text(f.units.pressure)
    smooth = "fast" if all(map(_is_even, cells)) else False
    return [
        {
            "type": "heatmap", "zsmooth": smooth, "x": x, "y": y, "z": single(pressure),
            "zmin": 0.0, "zmax": top,
            "colorscale": PRESSURE_MAP.capitalize(), "name": "pressure",
            "colorbar": {"title": {"text": axis_title("pressure", f.units.pressure), "side": "right"},
                         "thickness": 12},
            "hovertemplate": f"(%{{x:.4g}}, %{{y:.4g}}): %{{z:.4g}} {unit}<extra></extra>",
        },
        {
            "type": "heatmap", "x": x, "y": y, "z": regime.astype(np.int8), "zmin": -0.5,
            "zmax": 2.5, "colorscale": REGIME_SCALE, "visible": False, "name": "regime",
            "colorbar": {"tickvals": [0, 1, 2], "ticktext": list(REGIMES), "thickness": 12},
            "hovertemplate": "(%{x:.4g}, %{y:.4g}): regime %{z}<extra></extra>",
        },
    ]  # fmt: skip


def _force(f: Fields, prediction: Prediction | None) -> Drawing:
    weights = f.boundary.weights
    unit = f"{f.units.pressure} {f.units.length}" + ("^2" if len(f.boundary.names) == 2 else "")
    hover = f"%{{y:.5g}} {unit_text(unit)} at %{{x:.4g}} {unit_text(f.units.time)}"
    data = [line(f.times, f.pressure @ weights, "force", SERIES[0], hovertemplate=hover)]
    if prediction is not None:
        data.append(
            line(
                f.times, prediction.pressure @ weights, prediction.name, PREDICTED, "dash",
                hovertemplate=hover,
            )
        )  # fmt: skip
    return Drawing(
        "force",
        "Contact force over time",
        "The integral of the pressure over the boundary. The dashed curve is what the derivative in "
        "the chosen parameter predicts.",
        data,
        layout(300, ("time", f.units.time), ("force", unit), showlegend=True),
        has_time=True,
    )


def _bounds(f: Fields) -> Drawing:
    title = "Certified error" if f.status == "proved" else f"Error bound, {f.status}"
    top = float(np.nanmax(np.fmax(f.bound_x, f.bound_u)))
    # The bound grows from zero: decades below the largest values show nothing else.
    log = np.log10(top) if 0 < top < np.inf else 0.0
    return Drawing(
        "certificate",
        title,
        f"Bounds on the distance from the exact solution, in the L2 norm of the boundary ({f.status}).",
        [
            line(f.times, positive(f.bound_x), "indentation x", SERIES[0]),
            line(f.times, positive(f.bound_u), "reaction u", SERIES[1], "dash"),
        ],
        layout(
            280,
            ("time", f.units.time),
            ("error bound", f.norm),
            yaxis={**POWERS, "range": [log - 4.0, log + 0.3]},
        ),
        has_time=True,
    )
