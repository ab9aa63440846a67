"""The length of the next step of one mode, from the time scales of the mode."""

import numpy as np

from .modes import Equations


def shorter(own: Equations, h: float, excess: float, before: float) -> float:
    """The step to try next: half of it, as long as that pays (by 2²⁰ where the solution is resolved,
    but for little); else the next time scale of the mode, since a transient is there that is not."""
    if excess < 1e6 and excess < 0.1 * before:
        return 0.5 * h
    shorter = own.scales[own.scales < 0.6 * h]
    return float(shorter[-1]) if len(shorter) else h / 8.0


def longer(own: Equations, h: float, excess: float) -> float:
    """The step to try next: while a transient lasts, much the same; else the next time scale."""
    if excess > 1e-2:
        return h if excess > 0.1 else 1.5 * h
    longer = own.scales[own.scales > 1.5 * h]
    return float(longer[0]) if len(longer) else np.inf


def until(own: Equations, h: float, theta: float) -> float:
    """The step that ends soon after θ, no shorter than the shortest time scale of the mode."""
    return max(1.25 * theta * h, float(own.scales[0]) if len(own.scales) else h)


def two_sum(a: float, b: float) -> tuple[float, float]:
    """a + b and what rounding takes from it."""
    total = a + b
    other = total - a
    return total, (a - (total - other)) + (b - other)
