"""The dense output of `PiecewiseLinear`: the polynomials of all steps."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .records import Step


class Trajectory(eqx.Module):
    """The steps of a run as arrays, with one row per step.

    - `start`, `length`, `used`: the step begins at `start`, and its part up to θ = `used` is valid;
    - `x`, `y`: the polynomials, x at the nodes and y at the collocation points;
    - `rates`, `oscillation_x`, `oscillation_y`: the oscillations 2 Re e^{λt}(x, y), padded with zeros;
    - `changes`: the times at which the mode mode_after;
    - `modes`: a row for each change and a column for each entry of y (−1 at the lower bound, 1 at the
      upper one, 0 between them).
    """

    start: np.ndarray
    length: np.ndarray
    used: np.ndarray
    x: np.ndarray
    y: np.ndarray
    rates: np.ndarray
    oscillation_x: np.ndarray
    oscillation_y: np.ndarray
    changes: np.ndarray
    modes: np.ndarray

    @property
    def end(self) -> float:
        """The end of the last step."""
        return float(self.start[-1] + self.used[-1] * self.length[-1])

    def evaluate(self, t: Any) -> tuple[jax.Array, jax.Array]:
        """Return (x, y) at t as flat arrays."""
        k = int(np.clip(np.searchsorted(self.start, float(t), side="right") - 1, 0, None))
        theta = np.clip((float(t) - self.start[k]) / self.length[k], 0.0, self.used[k])
        step = Step(
            self.start[k], self.length[k], self.used[k], self.x[k], self.y[k],
            tuple(zip(self.rates[k], self.oscillation_x[k], self.oscillation_y[k], strict=True)),
        )  # fmt: skip
        x, y = step.evaluate(np.array([theta]))
        return jnp.asarray(x[0]), jnp.asarray(y[0])


class Changes(NamedTuple):
    """The `times` of changes, and between two of them the signs as in `Regimes`."""

    times: np.ndarray
    positive: np.ndarray


def signs(trajectory: Trajectory) -> Changes:
    """Return the modes between changes, without modes of zero duration."""
    times, rows = [trajectory.changes[0]], [trajectory.modes[0]]
    for t, mode in zip(trajectory.changes[1:], trajectory.modes[1:], strict=True):
        if t == times[-1]:
            rows[-1] = mode
        elif np.any(mode != rows[-1]):
            times.append(t)
            rows.append(mode)
    modes = np.array(rows)
    return Changes(np.array([*times, trajectory.end]), np.hstack([modes >= 0, modes <= 0]))
