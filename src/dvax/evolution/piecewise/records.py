"""Records of a run: attempted steps, accepted steps, and rows at saved times."""

from typing import NamedTuple

import numpy as np

from . import radau

Array = np.ndarray


_MIN_USED_PART, _MAX_GROWTH = 0.05, 4.0
"""A step is coarse if a switching ends it before this part of it, or if values grow by more than this
factor after the switching."""


class Step(NamedTuple):
    """An accepted step from `start`, whose part up to θ = `used` belongs to the trajectory.

    `x` holds the polynomial part at the nodes, `y` at the collocation points. `oscillations` holds
    (λ, x, y) of the terms 2 Re e^{λt}(x, y) that are added to it.
    """

    start: float
    length: float
    used: float
    x: Array
    y: Array
    oscillations: tuple[tuple[complex, Array, Array], ...]

    def evaluate(self, thetas: Array) -> tuple[Array, Array]:
        """Return (x, y), one row per θ."""
        x, y = radau.state_at(self.x, thetas), radau.multiplier_at(self.y, thetas)
        for rate, of_x, of_y in self.oscillations:
            factor = 2.0 * np.exp(rate * self.length * thetas)[:, None]
            x, y = x + (factor * of_x).real, y + (factor * of_y).real
        return x, y


class Row(NamedTuple):
    """The values saved at one time t: x, y and w = F(y) of the frozen law.

    - `defect`: the integrated defect of both equations up to the end of the step that contains t;
    - `completed_defect`: the same up to the start of that step;
    - `bounds`: bounds (low, high) on x and y since the saved time before, None if they are not tracked;
    - `of_w`: a bound on the error of w, if the defect is measured, else 0.
    """

    t: float
    x: Array
    y: Array
    w: Array
    defect: tuple[float, float]
    completed_defect: tuple[float, float]
    bounds: Array | None
    of_w: Array


class Crossing(NamedTuple):
    """The end, relative to the piece, and the length of the last step across several modes."""

    end: float
    length: float


class Attempt(NamedTuple):
    """A computed step, before the error test and the event location.

    - `x`, `ys`: the polynomials x at the nodes and y at the collocation points;
    - `y`, `w`: the polynomials y and w on the grid;
    - `slack`: the violations of bounds by y and by w that the sign test tolerates;
    - `oscillations`: (λ, x, y, w) of the terms in closed form; `amplitude` bounds them in y and in w;
    - `size`: the largest |x|; `noise`: the rounding error of x;
    - `truncation`: the estimated truncation error of x;
    - `error_ratio`: the largest estimated error relative to the allowed one.
    """

    x: Array
    ys: Array
    y: Array
    w: Array
    slack: tuple[Array, Array]
    oscillations: list[tuple[complex, Array, Array, Array]]
    amplitude: tuple[Array, Array]
    size: Array
    noise: Array
    truncation: Array
    error_ratio: float

    def waves(self, k: int, i: int) -> list[tuple[complex, complex]]:
        """Return (λ, amplitude) of the oscillations in entry i of y (k = 0) or of w (k = 1)."""
        return [(rate, (y, w)[k][i]) for rate, _, y, w in self.oscillations]

    def sizes(self, theta: float) -> tuple[Array, Array, Array]:
        """Return the largest |x|, |y| and |w| up to θ."""
        part = theta >= radau.GRID
        x = np.abs(radau.NODES_TO_GRID[part] @ self.x).max(axis=0)
        oscillation_size = self.size - np.abs(self.x).max(axis=0)
        y, w = (np.abs(v[part]).max(axis=0) for v in (self.y, self.w))
        return x + oscillation_size, y, w

    def is_coarse(self, theta: float) -> bool:
        """Return whether the error estimate of the whole step is too coarse for its part up to θ: the
        part is short, or the values after it are much larger."""
        x, y, w = self.sizes(theta)
        whole = self.sizes(1.0)
        grows = (np.any(b > _MAX_GROWTH * a) for a, b in zip((x, y, w), whole, strict=True))
        return theta < _MIN_USED_PART or any(grows)

    def widen(self, bounds: Array) -> Array:
        """Return bounds (low, high) that also contain this step, between its samples too."""
        x = radau.NODES_TO_GRID @ self.x
        oscillation_size = np.concatenate(
            [self.size - np.abs(self.x).max(axis=0), self.amplitude[0]]
        )
        low = np.concatenate([radau.lowest(v) for v in (x, self.y)]) - oscillation_size
        high = -np.concatenate([radau.lowest(-v) for v in (x, self.y)]) + oscillation_size
        return np.stack([np.minimum(bounds[0], low), np.maximum(bounds[1], high)])
