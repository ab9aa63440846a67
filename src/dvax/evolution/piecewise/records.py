"""What a run keeps of its steps: the attempt, the step that was kept, the saved row."""

from typing import NamedTuple

import numpy as np

from . import radau

Array = np.ndarray


_USED, _LARGER = 0.05, 4.0
"""The least part of a step that is used before a switching, and how much values may grow after it."""


class Step(NamedTuple):
    """x at the nodes and y at the collocation points of a step that begins at `start` in a piece, of
    which the part up to θ = `used` is the trajectory, and the oscillations 2 Re ae^{λt}(x, y) beside
    them."""

    start: float
    length: float
    used: float
    x: Array
    y: Array
    rings: tuple[tuple[complex, Array, Array], ...]

    def at(self, thetas: Array) -> tuple[Array, Array]:
        """(x, y) there, a row each."""
        x, y = radau.state_at(self.x, thetas), radau.multiplier_at(self.y, thetas)
        for rate, of_x, of_y in self.rings:
            factor = 2.0 * np.exp(rate * self.length * thetas)[:, None]
            x, y = x + (factor * of_x).real, y + (factor * of_y).real
        return x, y


class Row(NamedTuple):
    """What is saved at one time: x, y and F(y) = w of the frozen law; the `defect` of both equations up
    to the end of the step that the time lies in, and `completed_defect` up to its start; `bounds`, the
    bounds (low, high) of x and y so far, where they are asked for."""

    t: float
    x: Array
    y: Array
    w: Array
    defect: tuple[float, float]
    completed_defect: tuple[float, float]
    bounds: Array | None


class Crossing(NamedTuple):
    """Where in a piece the last crossing of several modes' bounds ended, and its length."""

    end: float
    length: float


class MaskedViolation(NamedTuple):
    """By how much y and w are beyond their bounds within the slack of a step, in the mean (a row each),
    and `state_error`, by how much the state would differ had the constraints changed."""

    violation: Array
    state_error: Array


class Attempt(NamedTuple):
    """A step that was computed: x at the nodes, y at the points, y and w on the grid with the `slack`
    that they may be off by; the `rings` beside these polynomials, (λ, x, y, w), and by how much they
    `swing` y and w at most; the `size` of the whole state; what the polynomials are `lacking` in x, and
    `excess`, the same in units of what is allowed; and the `residuals` of the state's and of the law's
    equations at θ = 0."""

    x: Array
    ys: Array
    y: Array
    w: Array
    slack: tuple[Array, Array]
    rings: list[tuple[complex, Array, Array, Array]]
    swing: tuple[Array, Array]
    size: Array
    noise: Array
    lacking: Array
    excess: float
    residuals: tuple[Array, Array]

    def waves(self, k: int, i: int) -> list[tuple[complex, complex]]:
        """(λ, amplitude) of the oscillations in entry i of y (k = 0) or of w (k = 1)."""
        return [(rate, (y, w)[k][i]) for rate, _, y, w in self.rings]

    def sizes(self, theta: float) -> tuple[Array, Array, Array]:
        """Of x, y and w up to θ."""
        part = theta >= radau.GRID
        x = np.abs(radau.FROM_NODES[part] @ self.x).max(axis=0)
        beside = self.size - np.abs(self.x).max(axis=0)
        y, w = (np.abs(v[part]).max(axis=0) for v in (self.y, self.w))
        return x + beside, y, w

    def is_coarse(self, theta: float) -> bool:
        """Whether so little of a step is used, or what follows is so much larger, that its accuracy is
        not that of the part up to θ."""
        x, y, w = self.sizes(theta)
        whole = self.sizes(1.0)
        grows = (np.any(b > _LARGER * a) for a, b in zip((x, y, w), whole, strict=True))
        return theta < _USED or any(grows)

    def widened(self, bounds: Array) -> Array:
        """(low, high) that hold a step as well, with the margin of polynomials between samples."""
        x = radau.FROM_NODES @ self.x
        beside = np.concatenate([self.size - np.abs(self.x).max(axis=0), self.swing[0]])
        low = np.concatenate([radau.lowest(v) for v in (x, self.y)]) - beside
        high = -np.concatenate([radau.lowest(-v) for v in (x, self.y)]) + beside
        return np.stack([np.minimum(bounds[0], low), np.maximum(bounds[1], high)])
