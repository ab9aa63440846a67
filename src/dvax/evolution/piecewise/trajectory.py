"""The dense output of `PiecewiseLinear`: the polynomials of all steps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..regimes import Regimes
from .records import Step


class Trajectory(eqx.Module):
    """The steps of a run.

    - `start`: the starts of the steps; `steps`: their polynomials and oscillations;
    - `changes`: the times at which the mode changes;
    - `modes`: a row for each change and a column for each entry of y (−1 at the lower bound, 1 at the
      upper one, 0 between them).
    """

    start: np.ndarray
    steps: tuple[Step, ...]
    changes: np.ndarray
    modes: np.ndarray

    @property
    def end(self) -> float:
        """The end of the last step."""
        last = self.steps[-1]
        return float(last.start + last.used * last.length)

    def evaluate(self, t: Any) -> tuple[jax.Array, jax.Array]:
        """Return (x, y) at t as flat arrays."""
        k = int(np.clip(np.searchsorted(self.start, float(t), side="right") - 1, 0, None))
        step = self.steps[k]
        theta = np.clip((float(t) - step.start) / step.length, 0.0, step.used)
        x, y = step.evaluate(np.array([theta]))
        return jnp.asarray(x[0]), jnp.asarray(y[0])


def signs(trajectory: Trajectory) -> Regimes:
    """Return the modes between changes, without modes of zero duration."""
    times, rows = [trajectory.changes[0]], [trajectory.modes[0]]
    for t, mode in zip(trajectory.changes[1:], trajectory.modes[1:], strict=True):
        if t == times[-1]:
            rows[-1] = mode
        elif np.any(mode != rows[-1]):
            times.append(t)
            rows.append(mode)
    modes = np.array(rows)
    return Regimes(np.array([*times, trajectory.end]), np.hstack([modes >= 0, modes <= 0]))
