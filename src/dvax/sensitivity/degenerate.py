"""Where along a trajectory the response has a kink, and of what kind.

The sets say by continuous functions s(z) where their projections have kinks (`switches`): at s = 0.
A trajectory that *crosses* zero transversally leaves the state differentiable, and u is not at that
one moment; so does one that *touches* zero and turns back. One that *stays* there has only one-sided
derivatives from then on: `jax.grad` returns that of the constrained side.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ..errors import InputError, InputProblem
from ..evolution import Implicit, Solution
from ..evolution.stepper import interpolate, local

_LOOKS = 8
"""Places in a step where it is looked at the switches."""

_MOMENT = 1e-3
"""The share of a run that counts as a moment."""


class Kink(NamedTuple):
    """From `start` to `end` (one moment but where it stays) the `switch` of the set is zero. For a
    `dvax.sets.Box` of m entries switch i < m is the lower bound of entry i, m + i the upper one."""

    start: float
    end: float
    switch: int
    kind: Literal["crosses", "touches", "stays"]


def kinks(sol: Solution, *, tol: float = 1e-6) -> list[Kink]:
    """The kinks of the response along a solution made with `dense=True`, in order of time.

    A switch below `tol` in size counts as zero: it must be above the error of the solution. What stays
    there for less than a thousandth of the run counts as a moment.

    **Raises:** `dvax.InputError` where the steps were not kept, or by an implicit method.

    ```python
    >>> import dvax
    >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
    ...                             kappa0=0.5, g=1.0, ell=3.0)
    >>> sol = dvax.solve(
    ...     model.problem, -1.0, 0.0, 2.0, rtol=1e-8, method=dvax.ETD4RK(), dense=True, max_steps=2**12
    ... )
    >>> [(round(kink.start, 4), kink.kind) for kink in dvax.sensitivity.kinks(sol)]
    [(0.3133, 'crosses'), (0.5241, 'crosses')]

    ```
    """
    if sol.records is None or isinstance(sol.setup.method, Implicit):
        raise InputError(
            InputProblem(
                "dvax.sensitivity.kinks",
                "a solution without its steps",
                "what happens between the saved times is looked at on the steps themselves",
                "Solve with dense=True and an exponential method",
            )
        )
    count = int(sol.stats["steps"])
    if count == 0 or not _switches(sol):
        return []
    times, values = _looked_at(sol, count)
    found: list[Kink] = []
    for k in range(values.shape[1]):
        found += _of_one(times, values[:, k], k, tol)
    return sorted(found)


def _switches(sol: Solution) -> bool:
    flow, x0, t0 = sol.flow, sol.setup.x0, sol.setup.number("t0")
    found = flow.switches(t0, x0, flow.problem.zero_control(x0))
    return found is not None and found.size > 0


def _looked_at(sol: Solution, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(times, switches at each of them)."""
    assert sol.records is not None
    flow, method = sol.flow, sol.setup.method
    steps = jtu.tree_map(lambda leaf: leaf[:count], sol.records)
    run = steps.start[0], steps.start[-1] + steps.length[-1]
    thetas = jnp.arange(_LOOKS, dtype=steps.start.dtype) / _LOOKS

    def look(step, theta):
        end, guess = step.start + step.length, flow.guess(step.x0)
        own, _ = local(method, flow, step.start, end, step.x0, guess, run)
        t = step.start + theta * step.length
        x = interpolate(own, step.length, theta, step.x0, step.coefficients)
        return t, flow.switches(t, x, flow.rate(t, x, flow.guess(x)).z)

    each = jax.jit(jax.vmap(lambda step: jax.vmap(lambda theta: look(step, theta))(thetas)))
    last = jtu.tree_map(lambda leaf: leaf[-1], steps)
    (times, values), (end, at_end) = each(steps), jax.jit(look)(last, jnp.ones((), thetas.dtype))
    return (
        np.append(np.asarray(times).ravel(), np.asarray(end)),
        np.concatenate([np.asarray(values).reshape(times.size, -1), np.asarray(at_end)[None]]),
    )


def _of_one(times: np.ndarray, s: np.ndarray, switch: int, tol: float) -> list[Kink]:
    """The kinks of one switch, from its values."""
    found: list[Kink] = []
    near = np.abs(s) <= tol
    i = 0
    while i < len(s):
        if near[i]:
            j = i
            while j + 1 < len(s) and near[j + 1]:
                j += 1
            before, after = (s[i - 1] if i > 0 else 0.0), (s[j + 1] if j + 1 < len(s) else 0.0)
            start, end = float(times[i]), float(times[j])
            lasts = end - start > _MOMENT * (times[-1] - times[0])
            kind = "stays" if lasts else "crosses" if before * after < 0 else "touches"
            if kind != "stays":
                start = end = float(times[i + int(np.argmin(np.abs(s[i : j + 1])))])
            found.append(Kink(start, end, switch, kind))
            i = j + 1
            continue
        if i + 1 < len(s) and s[i] * s[i + 1] < 0 and not near[i + 1]:
            moment = float(times[i] + (times[i + 1] - times[i]) * s[i] / (s[i] - s[i + 1]))
            found.append(Kink(moment, moment, switch, "crosses"))
        elif 0 < i < len(s) - 1 and abs(s[i]) <= min(abs(s[i - 1]), abs(s[i + 1])):
            # The parabola through three values may come nearer than any of them.
            least = abs(s[i]) - _dip(s[i - 1 : i + 2])
            if least <= tol:
                found.append(Kink(float(times[i]), float(times[i]), switch, "touches"))
        i += 1
    return found


def _dip(s: np.ndarray) -> float:
    """How much nearer to zero than its middle value the parabola through three values comes."""
    a, b, c = np.abs(s)
    bend = a - 2 * b + c
    return 0.0 if bend <= 0 else (a - c) ** 2 / (8 * bend)
