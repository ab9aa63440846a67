"""A trajectory in pieces: the polynomials of all steps."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .records import Step


class Trajectory(eqx.Module):
    """The steps of a run: `start` and `length`, of which the part up to θ = `used` belongs to the
    trajectory; `x` at the nodes and `y` at the collocation points of each, and beside them the
    oscillations of `rates` λ and amplitudes `ring_x` and `ring_y`, as many zeros as it takes among
    them; `changes` = when the mode changed, and `modes`, a row for each change and a column for each
    entry of y (−1 at the lower bound, 1 at the upper one, 0 between them)."""

    start: np.ndarray
    length: np.ndarray
    used: np.ndarray
    x: np.ndarray
    y: np.ndarray
    rates: np.ndarray
    ring_x: np.ndarray
    ring_y: np.ndarray
    changes: np.ndarray
    modes: np.ndarray

    @property
    def end(self) -> float:
        """The time that the last step reached."""
        return float(self.start[-1] + self.used[-1] * self.length[-1])

    def at(self, t: Any) -> tuple[jax.Array, jax.Array]:
        """(x, y) at t, flat."""
        k = int(np.clip(np.searchsorted(self.start, float(t), side="right") - 1, 0, None))
        theta = np.clip((float(t) - self.start[k]) / self.length[k], 0.0, self.used[k])
        step = Step(
            self.start[k], self.length[k], self.used[k], self.x[k], self.y[k],
            tuple(zip(self.rates[k], self.ring_x[k], self.ring_y[k], strict=True)),
        )  # fmt: skip
        x, y = step.at(np.array([theta]))
        return jnp.asarray(x[0]), jnp.asarray(y[0])


class Changes(NamedTuple):
    """`times` and, between two of them, the signs that `Regimes` has."""

    times: np.ndarray
    positive: np.ndarray


def signs(found: Trajectory) -> Changes:
    """The modes between changes, those of no length left out."""
    times, rows = [found.changes[0]], [found.modes[0]]
    for t, mode in zip(found.changes[1:], found.modes[1:], strict=True):
        if t == times[-1]:
            rows[-1] = mode
        elif np.any(mode != rows[-1]):
            times.append(t)
            rows.append(mode)
    modes = np.array(rows)
    return Changes(np.array([*times, found.end]), np.hstack([modes >= 0, modes <= 0]))
