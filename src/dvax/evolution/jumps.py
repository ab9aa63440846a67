"""A jump of K, h or f in t or in x, or the steps that rounding makes of it, where a run stopped."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._tree import Tree
from ..errors import Fix, InputError
from .stopped import LAST_STEPS, Diagnosis, Stop

_JUMP, _ROUNDINGS = 1e-7, 1e3
"""A change of a function within two roundings of t is a jump above this part of its size, or so many
of its own roundings."""
_IN_X = 1e-3
"""A change of x' between two states that rounding tells apart is a jump above this part of its size."""
_FAR = 1e3
"""|t| in lengths of the run, from which on t itself is a term that cancels."""
_STAIR = 1e-3
"""Part of the size of a function below which many jumps of it are taken for rounding."""


def find_jump(stop: Stop) -> Diagnosis:
    """A jump of K, h or f in t, next to where the run stopped."""
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
            again = _change(values(stop.t), values(stop.t))[0]
            a, b, before, after = _narrow(values, low, high, stop.ulp)
        except InputError:
            continue  # refused within the window: that is another cause
        if again > 0.0:
            return Diagnosis(
                f"{name} has two values at one time, {again:.3g} apart at t = {stop.t:.12g}: it is no "
                "function of its arguments.",
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
        if not (change > max(_JUMP, _ROUNDINGS * eps) * size and b - a < 1e-9 * (t1 - t0)):
            continue
        # Both halves of what is longer, the part before the jump or the part after it.
        left, right = max((low, a), (b, high), key=lambda part: part[1] - part[0])
        middle = 0.5 * (left + right)
        beside = [_narrow(values, *part, stop.ulp) for part in ((left, middle), (middle, right))]
        many = all(_change(*found[2:])[0] > 0.25 * change for found in beside)
        if many and change < _STAIR * size:
            return _stairs(stop, name, change, b)
        where = f" in component {k}" if before.size > 1 else ""
        return Diagnosis(
            f"{name} jumps from {before[k]:.6g} to {after[k]:.6g}{where} at t = {b:.15g}, and no "
            "step across a jump that is not announced meets the tolerance.",
            (
                Fix(
                    "", "",
                    f"Name the time, so that a step ends there: write what jumps in {name} as "
                    f"dvax.signals.Function(fn, knots=[{b:.15g}]) and evaluate that, or compare t with "
                    "the time itself (jnp.where(t < a, …))",
                ),
            ),
        )  # fmt: skip
    return Diagnosis()


def find_discontinuity(stop: Stop) -> Diagnosis:
    """A jump of f̃ in x, at fixed t, on the line along x' through where the run stopped."""
    t = stop.time(stop.t)
    along = stop.velocity(t, stop.x)
    speed = stop.norm(along)
    if not (np.isfinite(speed) and speed > 0.0):
        return Diagnosis()

    def velocity(s: float) -> Tree:
        return stop.velocity(t, jtu.tree_map(lambda x, v: x + stop.time(s) * v, stop.x, along))

    def values(s: float) -> np.ndarray:
        return np.concatenate([np.ravel(leaf) for leaf in jtu.tree_leaves(velocity(s))])

    eps = float(jnp.finfo(stop.setup.dtype).eps)
    ulp = eps * stop.norm(stop.x) / speed
    far = LAST_STEPS * max(stop.step, 4.0 * stop.ulp, 4.0 * ulp)
    within = max(ulp, 1e-12 * far)
    a, b, *_ = _narrow(values, -far, far, within)
    # Next to the jump and not at it, where sign(0) = 0 lies between both sides.
    before, after = values(a - 4.0 * within), values(b + 4.0 * within)
    change, k = _change(before, after)
    size = float(np.max(np.abs(np.stack([before, after])), initial=0.0))
    # What is only steep changes more over a wider part.
    wider, _ = _change(values(a - 32.0 * within), values(b + 32.0 * within))
    if not (change > _IN_X * size and change > 0.5 * wider):
        return Diagnosis()
    where = f" in component {k}" if before.size > 1 else ""
    # The jump itself is a direction in which both sides differ.
    jump = after - before
    enters = float(before @ jump) * float(after @ jump) < 0.0
    slides = " It points to the jump from both sides: the solution would slide along it."
    return Diagnosis(
        f"x' jumps as a function of x, from {before[k]:.6g} to {after[k]:.6g}{where}, at t = "
        f"{stop.t:.12g}.{slides if enters else ''} A solution needs f to be continuous in x.",
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
    """The part of [a, b] of about two roundings in which the values change most, by bisection."""
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


def _stairs(stop: Stop, name: str, height: float, t: float) -> Diagnosis:
    """Jumps of about one height beside each other: rounding of terms far larger than their sum."""
    horizon = float(stop.setup.setting["horizon"])
    t0, t1 = stop.span
    cure = f"Write {name} so that large terms do not cancel"
    if max(abs(t0), abs(t1)) > _FAR * (t1 - t0):
        cure = "Count time from the start of the run, so that |t| is not large against t1 − t0"
    return Diagnosis(
        f"{name} changes in jumps of about {height:.3g} near t = {t:.12g}, as the rounding of terms "
        "that cancel does, and the tolerance asks for less.",
        (Fix("atol", f"{2.0 * height * horizon:.1g}", "which rounding allows"), Fix("", "", cure)),
    )


def _change(a: np.ndarray, b: np.ndarray) -> tuple[float, int]:
    """The largest change of a component, and which it is."""
    if a.size == 0:
        return 0.0, 0
    with np.errstate(invalid="ignore"):  # bounds of K may be infinite
        apart = np.where(a == b, 0.0, np.abs(b - a))
    apart = np.where(np.isfinite(apart), apart, 0.0)
    k = int(np.argmax(apart))
    return float(apart[k]), k
