"""Proposals for the length of the next step, from the time scales of the mode."""

import numpy as np

from .modes import Equations


def shorten(equations: Equations, h: float, error_ratio: float, last_error_ratio: float) -> float:
    """Return the length to try after a rejected step.

    Halving reduces the error by up to 2²⁰ once the polynomial resolves the solution. As long as
    halving is that effective, return h/2. Otherwise a transient is unresolved: return the next shorter
    time scale of the mode.
    """
    if error_ratio < 1e6 and error_ratio < 0.1 * last_error_ratio:
        return 0.5 * h
    shorter = equations.scales[equations.scales < 0.6 * h]
    return float(shorter[-1]) if len(shorter) else h / 8.0


def lengthen(equations: Equations, h: float, error_ratio: float) -> float:
    """Return the length to try after an accepted step.

    While a transient lasts the error ratio is large: return about the same length. Otherwise return the
    next longer time scale of the mode.
    """
    if error_ratio > 1e-2:
        return h if error_ratio > 0.1 else 1.5 * h
    longer = equations.scales[equations.scales > 1.5 * h]
    return float(longer[0]) if len(longer) else np.inf


def length_past(equations: Equations, h: float, theta: float) -> float:
    """Return the length of a step that ends soon after the switching at θ of a step of length h.

    It is at least the shortest time scale of the mode.
    """
    return max(1.25 * theta * h, float(equations.scales[0]) if len(equations.scales) else h)


def two_sum(a: float, b: float) -> tuple[float, float]:
    """Return a + b, rounded, and its rounding error."""
    total = a + b
    other = total - a
    return total, (a - (total - other)) + (b - other)
