"""The contact law of Section 7 with data that is constant in time, and its exact solution.

    x' = ℓ − (α + d_x) x − d_u u,   u = clip((g − b_x x)/(1 + b_u), 0, κ₀/β)

At every point this is a scalar autonomous equation with three affine pieces: x runs monotonically
towards its rest, through each piece at most once, exponentially in each. So the solution is a
closed form of three pieces at most, which shares no code with dvax.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

import dvax

_PIECES = 3


@dataclass(frozen=True, eq=False)
class ContactLaw:
    """The paper's letters; `g` is a number a point, `x0` the start of every point."""

    alpha: float
    beta: float
    b_x: float
    b_u: float
    d_x: float
    d_u: float
    kappa0: float
    ell: float
    g: np.ndarray
    x0: float

    @cached_property
    def model(self) -> dvax.models.Contact:
        """The same law in dvax; a single point is a scalar there."""
        return dvax.models.Contact(
            alpha=self.alpha, beta=self.beta, b_x=self.b_x, b_u=self.b_u, d_x=self.d_x,
            d_u=self.d_u, kappa0=self.kappa0, ell=self.ell, g=self._shaped(self.g),
        )  # fmt: skip

    @cached_property
    def start(self) -> np.ndarray:
        return self._shaped(np.full(self.g.shape, self.x0))

    def _shaped(self, values: np.ndarray) -> np.ndarray:
        return values[0] if values.size == 1 else values

    @property
    def capacity(self) -> float:
        """The largest reaction, κ₀/β."""
        return self.kappa0 / self.beta

    def response(self, x: np.ndarray) -> np.ndarray:
        """u_x, the law solved by hand."""
        return np.clip((self.g - self.b_x * x) / (1.0 + self.b_u), 0.0, self.capacity)

    def slope(self, x: np.ndarray) -> np.ndarray:
        """x'."""
        return self.ell - (self.alpha + self.d_x) * x - self.d_u * self.response(x)

    def exact(self, t: float) -> np.ndarray:
        """x(t) at every point.

        **Raises:** `ValueError` where the active piece does not decay, since the closed form below
        divides by its rate.
        """
        outer = self.alpha + self.d_x
        gain = self.d_u / (1.0 + self.b_u)
        inner = outer - gain * self.b_x
        if inner <= 0.0:
            raise ValueError(
                f"the active piece has the rate {inner:g}, which must be positive: take "
                "d_u b_x/(1 + b_u) below alpha + d_x"
            )
        full = (self.g - (1.0 + self.b_u) * self.capacity) / self.b_x
        free = self.g / self.b_x
        x, left = np.full(self.g.shape, self.x0), np.full(self.g.shape, float(t))
        for _ in range(_PIECES):
            up = self.slope(x) > 0.0
            # On a border, the piece on the side to which x moves.
            saturated = (x < full) | ((x == full) & ~up)
            unloaded = (x > free) | ((x == free) & up)
            rate = np.where(saturated | unloaded, outer, inner)
            drive = np.where(
                saturated,
                self.ell - self.d_u * self.capacity,
                np.where(unloaded, self.ell, self.ell - gain * self.g),
            )
            rest = drive / rate
            above = np.where(saturated, full, np.where(unloaded, np.inf, free))
            below = np.where(unloaded, free, np.where(saturated, -np.inf, full))
            border = np.where(up, above, below)
            leaves = np.where(up, rest > border, rest < border)
            # The quotient is only formed where x reaches the border: elsewhere it is 1 here.
            start, end = np.where(leaves, x - rest, 1.0), np.where(leaves, border - rest, 1.0)
            needed = np.where(leaves, np.log(start / end) / rate, np.inf)
            arrives = needed <= left
            span = np.where(arrives, needed, left)
            x = np.where(arrives, border, rest + (x - rest) * np.exp(-rate * span))
            left = left - span
        return x

    def error(self, x: object, t: float) -> float:
        """The largest entry of |x − x(t)|."""
        return float(np.max(np.abs(np.asarray(x).reshape(self.g.shape) - self.exact(t))))


def strip(points: int) -> ContactLaw:
    """A strip whose demand is a wave: all three regimes occur along it."""
    wave = 1.0 + np.sin(2.0 * np.pi * (np.arange(points) + 0.5) / points)
    return ContactLaw(
        alpha=1.0, beta=2.0, b_x=1.0, b_u=0.5, d_x=0.2, d_u=0.8, kappa0=0.6, ell=0.5, g=wave, x0=0.0
    )


def single() -> ContactLaw:
    """One point that passes through all three regimes up to t = 2 (conformance case C1)."""
    return ContactLaw(
        alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0, kappa0=0.5, ell=3.0,
        g=np.ones(1), x0=-1.0,
    )  # fmt: skip
