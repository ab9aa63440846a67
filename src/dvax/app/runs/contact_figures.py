"""The contact law's headline figures, gathered block by block."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from dvax.app.runs.contact_frames import norm_unit
from dvax.app.runs.contact_inputs import ContactInputs
from dvax.app.runs.figure import Figure
from dvax.app.runs.settings import Config
from dvax.theory import Constants, Status, weakest


class Figures:
    """Peaks, forces and fractions over all frames so far, and the certificate at the end."""

    def __init__(self, inputs: ContactInputs, config: Config, constants: Constants):
        self._boundary, self._units, self._constants = inputs.boundary, config.units, constants
        self._config = config
        self._weights = inputs.boundary.weights
        self._measure = float(self._weights.sum())
        self._end = config.time.end
        self._kappa0 = config.model.kappa0
        self._peak = (-np.inf, 0.0, 0)
        self._deepest = (-np.inf, 0.0, 0)
        self._force = (-np.inf, 0.0)
        self._saturated = self._unloaded = 0.0
        self._last: dict[str, float] = {}
        self.status: Status = "proved"
        """Of the bounds so far."""

    def add(self, times: np.ndarray, values: Mapping[str, np.ndarray], status: Status) -> None:
        """Take a block of frames into account; `status` says how much is known of its bounds."""
        self.status = weakest(self.status, status)
        pressure, regime, weights = values["pressure"], values["regime"], self._weights
        force = pressure @ weights
        self._peak = _larger(self._peak, _largest(times, pressure))
        self._deepest = _larger(self._deepest, _largest(times, values["indentation"]))
        strongest = int(np.argmax(force))
        self._force = max(self._force, (float(force[strongest]), float(times[strongest])))
        fractions = [((regime == k) @ weights / self._measure) for k in (0, 2)]
        self._unloaded = max(self._unloaded, float(fractions[0].max()))
        self._saturated = max(self._saturated, float(fractions[1].max()))
        self._last = {
            "time": float(times[-1]),
            "force": float(force[-1]),
            "unloaded": float(fractions[0][-1]),
            "saturated": float(fractions[1][-1]),
            **{
                name: float(values[name][-1])
                for name in (
                    "error_bound_x",
                    "error_bound_u",
                    "error_bound_sharp_x",
                    "separation_x",
                )
            },
            "law_error": float(values["law_error"].max()),
            "norm_x": float(np.sqrt(values["indentation"][-1] ** 2 @ weights)),
        }

    @np.errstate(over="ignore", invalid="ignore")  # a rate that overflows is infinite
    def summary(self, steps: int) -> dict[str, Figure]:
        """The figures by name."""
        if not self._last:
            return {}
        u, last, c = self._units, self._last, self._constants
        width = len(self._boundary.coordinates)
        force = f"{u.pressure} {u.length}" + ("^2" if width == 2 else "")
        norm = norm_unit(self._config, width)
        of_law = c.status_of("gamma", "norm_P_inv")
        rows: list[tuple[str, Any, str, str]] = [
            ("end_time", last["time"], u.time, "time of the last saved frame"),
            ("peak_pressure", self._peak[0], u.pressure, "largest pressure anywhere"),
            ("peak_pressure_time", self._peak[1], u.time, "when it was reached first"),
            ("peak_pressure_place", self._place(self._peak[2]), u.length, "where"),
            ("peak_force", self._force[0], force, "largest total contact force, ∫ p ds"),
            ("peak_force_time", self._force[1], u.time, "when it was reached"),
            ("final_force", last["force"], force, "total contact force at the end"),
            ("peak_indentation", self._deepest[0], u.indentation, "largest indentation anywhere"),
            ("peak_saturated_fraction", self._saturated, "1",
             "largest part of the boundary at its pressure capacity"),
            ("peak_unloaded_fraction", self._unloaded, "1", "largest part of the boundary unloaded"),
            ("final_saturated_fraction", last["saturated"], "1", "part at capacity at the end"),
            ("final_unloaded_fraction", last["unloaded"], "1", "part unloaded at the end"),
            ("error_bound_x", last["error_bound_x"], norm,
             f"bound on ‖x_h − x‖ in L2 at the end, paper's constants ({self.status})"),
            ("error_bound_sharp_x", last["error_bound_sharp_x"], norm,
             f"bound on ‖x_h − x‖ in L2 at the end, one-sided rate ({self.status})"),
            ("error_bound_u", last["error_bound_u"], norm,
             f"bound on ‖u_h − u‖ in L2 at the end ({self.status})"),
            ("law_error", last["law_error"], norm,
             f"bound on the error of a frozen solve ({of_law})"),
            ("decay_rate", float(c.decay_rate), f"1/{u.time}",
             "two trajectories certainly approach at this rate, where positive"),
            ("sharp_decay_rate", float(c.sharp_decay_rate), f"1/{u.time}",
             "the same rate, where the sign of the feedback counts"),
            ("final_separation", last["separation_x"], norm,
             "‖x1 − x2‖ of the two trajectories at the end"),
            ("steps", steps, "1", "accepted time steps"),
        ]  # fmt: skip
        bounds: dict[str, str] = {"law_error": of_law}
        bounds |= dict.fromkeys(
            ("error_bound_x", "error_bound_sharp_x", "error_bound_u"), self.status
        )
        size = last["norm_x"]
        relative = {
            name: last[name] / size
            for name in ("error_bound_x", "error_bound_sharp_x")
            if 0 < size < np.inf
        }
        return {
            name: Figure(value, unit, meaning, bound=bounds.get(name), relative=relative.get(name))
            for name, value, unit, meaning in rows
        }

    def _place(self, point: int) -> Any:
        place = [float(c[point]) for c in self._boundary.coordinates]
        return place if len(place) > 1 else place[0]


def _largest(times: np.ndarray, field: np.ndarray) -> tuple[float, float, int]:
    # The first entry that reaches the maximum up to roundoff, so that a plateau is found at its start.
    top = float(field.max())
    reached = np.argmax(field >= top - 1e-12 * abs(top))
    frame, point = np.unravel_index(int(reached), field.shape)
    return float(field[frame, point]), float(times[frame]), int(point)


def _larger(
    old: tuple[float, float, int], new: tuple[float, float, int]
) -> tuple[float, float, int]:
    """Return the one with the larger value, the earlier one where they differ by roundoff only."""
    return new if new[0] > old[0] + 1e-12 * abs(old[0]) or old[0] == -np.inf else old
