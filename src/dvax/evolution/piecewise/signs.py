"""Signs of what a step computed: the first constraint that changes, and violations that slack masks."""

from collections.abc import Callable

import numpy as np

from . import radau
from .modes import Condition, Equations, Mode, changed
from .records import Attempt, MaskedViolation
from .system import Affine


def locate_event(own: Equations, found: Attempt, h: float) -> tuple[float, Condition | None]:
    """(θ, condition) of the first condition that fails; (θ, None) where all hold up to θ."""
    theta, first = 1.0, None
    for c in own.conditions:
        k = int(c.of_w)
        grid, slack, swing = (v[k] for v in ((found.y, found.w), found.slack, found.swing))
        signed, allowed = c.sign * (grid[:, c.i] - c.bound), float(slack[c.i])
        if theta == 0.0 or radau.lowest(signed) - swing[c.i] >= -allowed:
            continue
        waves = [
            radau.Wave(rate * h, c.sign * amplitude)
            for rate, amplitude in found.waves(k, c.i)
            if amplitude != 0.0
        ]
        when, fails = radau.first_negative(signed, allowed, theta, waves)
        if fails or when < theta:
            theta, first = when, c if fails else None
    return theta, first


def masked_violation(
    of: Callable[[Mode], Equations],
    given: Affine,
    own: Equations,
    found: Attempt,
    theta: float,
    h: float,
) -> MaskedViolation:
    """What y and w are beyond their bounds within the slack up to θ, in the mean, and by how much the
    state would differ had the constraints changed."""
    violation, state_error = np.zeros((2, len(own.mode))), np.zeros(found.x.shape[1])
    before = radau.GRID <= theta
    thetas = radau.GRID[before]
    # The trapezoidal rule, since samples are dense at the ends.
    part = np.gradient(thetas) if len(thetas) > 1 else np.ones(1)
    for c in own.conditions if theta > 0.0 else ():
        k = int(c.of_w)
        value = (found.y, found.w)[k][before, c.i] - c.bound
        for rate, amplitude in found.waves(k, c.i):
            value = value + 2.0 * np.real(amplitude * np.exp(rate * h * thetas))
        mean = np.average(np.clip(-c.sign * value, 0.0, found.slack[k][c.i]), weights=part)
        violation[k, c.i] = mean
        if mean > 0.0:
            # A residual below zero is a response in the mode that would follow, and what follows from
            # a response that would be at its bound there is known from that mode as well.
            response = mean / given.M[c.i, c.i] if c.of_w else mean
            state_error += of(changed(own.mode, c)).reach(theta * h, given.B)[:, c.i] * response
    return MaskedViolation(violation, state_error)
