"""Sign tests of a computed step: the first failing condition, and violations masked by the slack."""

from collections.abc import Callable

import numpy as np

from . import radau
from .modes import Condition, Equations, Mode, mode_after
from .records import Attempt
from .system import Affine


def locate_event(
    equations: Equations, attempt: Attempt, h: float
) -> tuple[float, Condition | None]:
    """Return θ and the condition that fails first there, or (θ, None) if all hold up to θ."""
    theta, first = 1.0, None
    for c in equations.conditions:
        k = int(c.of_w)
        grid, slack, swing = (
            v[k] for v in ((attempt.y, attempt.w), attempt.slack, attempt.amplitude)
        )
        signed, allowed = c.sign * (grid[:, c.i] - c.bound), float(slack[c.i])
        if theta == 0.0 or radau.lowest(signed) - swing[c.i] >= -allowed:
            continue
        waves = [
            radau.Wave(rate * h, c.sign * amplitude)
            for rate, amplitude in attempt.waves(k, c.i)
            if amplitude != 0.0
        ]
        candidate, fails = radau.first_negative(signed, allowed, theta, waves)
        if fails or candidate < theta:
            theta, first = candidate, c if fails else None
    return theta, first


def masked_error(
    equations_of: Callable[[Mode], Equations],
    system: Affine,
    equations: Equations,
    attempt: Attempt,
    theta: float,
    h: float,
) -> np.ndarray:
    """Return an estimate of how much x would change if the constraints switched that the slack holds
    up to θ, from their mean violations."""
    state_error = np.zeros(attempt.x.shape[1])
    before = radau.GRID <= theta
    thetas = radau.GRID[before]
    # Use the weights of the trapezoidal rule: the samples are denser at the ends.
    weights = np.gradient(thetas) if len(thetas) > 1 else np.ones(1)
    for c in equations.conditions if theta > 0.0 else ():
        k = int(c.of_w)
        value = (attempt.y, attempt.w)[k][before, c.i] - c.bound
        for rate, amplitude in attempt.waves(k, c.i):
            value = value + 2.0 * np.real(amplitude * np.exp(rate * h * thetas))
        mean = np.average(np.clip(-c.sign * value, 0.0, attempt.slack[k][c.i]), weights=weights)
        if mean > 0.0:
            # In the mode after a switching, a negative residual w becomes a response w/M. The gain of
            # that mode gives the effect of the response on the state.
            response = mean / system.M[c.i, c.i] if c.of_w else mean
            state_error += (
                equations_of(mode_after(equations.mode, c)).disturbance_gain(theta * h, system.B)[
                    :, c.i
                ]
                * response
            )
    return state_error
