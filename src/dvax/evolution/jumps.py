"""Detection of jumps of K, h or f in t or in x near the time at which a run stopped."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._tree import Tree
from ..errors import Fix, InputError
from .stopped import LAST_STEPS, Diagnosis, Stop

_MIN_JUMP, _MIN_JUMP_EPS = 1e-7, 1e3
"""Smallest jump of a function in t, relative to its size, and the same in units of eps."""
_MIN_JUMP_IN_X = 1e-3
"""Smallest jump of x' between two neighbouring states, relative to its size."""
_MAX_TIME_RATIO = 1e3
"""Ratio of |t| to the length of the run above which the roundoff of t is blamed."""
_MAX_ROUNDOFF_JUMP = 1e-3
"""Jumps smaller than this part of the function are roundoff if there are many of them."""


def find_jump(stop: Stop) -> Diagnosis:
    """Detect a jump of K, h or f in t near the time at which the run stopped."""
    flow, problem, args = stop.flow, stop.flow.problem, stop.flow.args
    t0, t1 = stop.span
    width = LAST_STEPS * max(stop.step, 4.0 * stop.ulp)
    low, high = max(t0, stop.t - width), min(t1, stop.t + width)
    u = flow.operator.inverse(flow.rate(stop.time(stop.t), stop.x, None).y)
    pieces: dict[str, Callable[[Any], Tree]] = {
        "K": lambda s: problem.set_at(s, args),
        "h": lambda s: problem.h(s, stop.x, u, args),
        "f": lambda s: problem.f(s, stop.x, u, args),
    }
    eps = float(jnp.finfo(stop.setup.dtype).eps)
    for name, evaluate in pieces.items():

        def values(s: float, evaluate: Callable[[Any], Tree] = evaluate) -> np.ndarray:
            leaves = [np.ravel(leaf) for leaf in jtu.tree_leaves(evaluate(stop.time(s)))]
            return np.concatenate(
                [leaf for leaf in leaves if leaf.dtype.kind == "f"] or [np.zeros(0)]
            )

        try:
            difference = _change(values(stop.t), values(stop.t))[0]
            a, b, before, after = _narrow(values, low, high, stop.ulp)
        except InputError:
            continue  # the function raises in this interval, which is another cause
        if difference > 0.0:
            return Diagnosis(
                f"{name} returned two values that differ by {difference:.3g} for the same arguments, "
                f"at t = {stop.t:.12g}: it is not a function of its arguments.",
                (
                    Fix(
                        "", "",
                        f"Make {name} depend on t, x, u and args alone: no random numbers of NumPy, no "
                        "counters, no lists that grow",
                    ),
                ),
            )  # fmt: skip
        change, k = _change(before, after)
        size = float(np.max(np.abs(np.stack([before, after])), initial=0.0))
        if not (change > max(_MIN_JUMP, _MIN_JUMP_EPS * eps) * size and b - a < 1e-9 * (t1 - t0)):
            continue
        # Search for similar jumps in both halves of the longer part beside this one.
        left, right = max((low, a), (b, high), key=lambda part: part[1] - part[0])
        middle = 0.5 * (left + right)
        others = [_narrow(values, *part, stop.ulp) for part in ((left, middle), (middle, right))]
        has_similar_jumps = all(_change(*other[2:])[0] > 0.25 * change for other in others)
        if has_similar_jumps and change < _MAX_ROUNDOFF_JUMP * size:
            if change < _largest_defect(stop):
                continue
            return _roundoff_jumps(stop, name, change, b)
        where = f" in component {k}" if before.size > 1 else ""
        return Diagnosis(
            f"{name} jumps from {before[k]:.6g} to {after[k]:.6g}{where} at t = {b:.15g}, and no "
            "step across an undeclared jump meets the tolerance.",
            (
                Fix(
                    "", "",
                    f"Declare the time, so that a step ends there: write the part of {name} that jumps "
                    f"as dvax.signals.Function(fn, knots=[{b:.15g}]), or compare t with the time "
                    "directly (jnp.where(t < a, …))",
                ),
            ),
        )  # fmt: skip
    return Diagnosis()


def find_discontinuity(stop: Stop) -> Diagnosis:
    """Detect a jump of f̃ in x at fixed t, on the line along x' through the last state."""
    t = stop.time(stop.t)
    direction = stop.velocity(t, stop.x)
    speed = stop.norm(direction)
    if not (np.isfinite(speed) and speed > 0.0):
        return Diagnosis()

    def velocity(s: float) -> Tree:
        return stop.velocity(t, jtu.tree_map(lambda x, v: x + stop.time(s) * v, stop.x, direction))

    def values(s: float) -> np.ndarray:
        return np.concatenate([np.ravel(leaf) for leaf in jtu.tree_leaves(velocity(s))])

    eps = float(jnp.finfo(stop.setup.dtype).eps)
    ulp = eps * stop.norm(stop.x) / speed
    far = LAST_STEPS * max(stop.step, 4.0 * stop.ulp, 4.0 * ulp)
    width = max(ulp, 1e-12 * far)
    a, b, *_ = _narrow(values, -far, far, width)
    # Evaluate beside the jump, since a value at the jump, such as sign(0) = 0, may lie between.
    before, after = values(a - 4.0 * width), values(b + 4.0 * width)
    change, k = _change(before, after)
    size = float(np.max(np.abs(np.stack([before, after])), initial=0.0))
    # A function that is steep, but continuous, changes more over a wider interval.
    wider, _ = _change(values(a - 32.0 * width), values(b + 32.0 * width))
    if not (change > _MIN_JUMP_IN_X * size and change > 0.5 * wider):
        return Diagnosis()
    where = f" in component {k}" if before.size > 1 else ""
    # Compare the components of both sides along the jump.
    jump = after - before
    is_sliding = float(before @ jump) * float(after @ jump) < 0.0
    sliding = " It points to the jump from both sides: the solution would slide along it."
    return Diagnosis(
        f"x' jumps as a function of x, from {before[k]:.6g} to {after[k]:.6g}{where}, at t = "
        f"{stop.t:.12g}.{sliding if is_sliding else ''} A solution needs f to be continuous in x.",
        (
            Fix(
                "", "",
                "Write the switch as a law: with K = Box(-1, 1) and h = g(x)/ε the response u = "
                "clip(g(x)/ε, -1, 1) is the sign of g(x) outside a layer of width ε",
            ),
        ),
    )  # fmt: skip


def _narrow(
    values: Callable[[float], np.ndarray], a: float, b: float, ulp: float
) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Return the subinterval of [a, b] of length 2 ulp in which the values change most, by bisection,
    and the values at its ends."""
    before, after = values(a), values(b)
    while b - a > 2.0 * max(ulp, 5e-324):
        middle = 0.5 * (a + b)
        if not a < middle < b:
            break
        between = values(middle)
        if _change(before, between)[0] >= _change(between, after)[0]:
            b, after = middle, between
        else:
            a, before = middle, between
    return a, b, before, after


def _largest_defect(stop: Stop) -> float:
    """Return the defect that the tolerance allows."""
    rtol, atol, horizon = (float(stop.setup.setting[n]) for n in ("rtol", "atol", "horizon"))
    return (atol + rtol * stop.norm(stop.x)) / horizon


def _roundoff_jumps(stop: Stop, name: str, height: float, t: float) -> Diagnosis:
    """Return the diagnosis of many jumps of one height: roundoff of large terms that cancel."""
    horizon = float(stop.setup.setting["horizon"])
    t0, t1 = stop.span
    fix = f"Write {name} so that large terms do not cancel"
    if max(abs(t0), abs(t1)) > _MAX_TIME_RATIO * (t1 - t0):
        fix = "Count time from the start of the run, so that |t| is not large against t1 − t0"
    return Diagnosis(
        f"{name} changes in jumps of about {height:.3g} near t = {t:.12g}, as roundoff of terms that "
        "cancel does, and the tolerance requires less.",
        (Fix("atol", f"{2.0 * height * horizon:.1g}", "which rounding allows"), Fix("", "", fix)),
    )


def _change(a: np.ndarray, b: np.ndarray) -> tuple[float, int]:
    """Return the largest change of a component, and its index."""
    if a.size == 0:
        return 0.0, 0
    with np.errstate(invalid="ignore"):  # bounds of K may be infinite
        change = np.where(a == b, 0.0, np.abs(b - a))
    change = np.where(np.isfinite(change), change, 0.0)
    k = int(np.argmax(change))
    return float(change[k]), k
