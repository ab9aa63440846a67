"""Diagnosis of a failed solve: the cause, and the options that fix it.

The tests evaluate the functions of the problem near the last state (t, x). They detect:

- a non-finite value: evaluate K, P, A, h and f along x + s x' over the next steps, and bisect for the
  earliest such time;
- a jump of K, h or f in t: bisect a few steps around t; many jumps of one height are roundoff;
- a jump of x' as a function of x: bisect on the line along x';
- a finite-time escape: x' grows as |x|^p with p > 1, so x is infinite after |x| / ((p − 1) |x'|);
- roundoff: steps as small as the spacing of floating-point numbers at t, or a tolerance below the
  rounding error of f;
- stiffness: the largest eigenvalue of the derivative of f̃ (of Ax + f̃ for explicit methods), found by
  power iteration, times h is of order one, while x changes far more slowly;
- a law that is not monotone: the smallest eigenvalue of the symmetric part of ∂F/∂y is not positive.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import Fix, InputError, SolveError
from .implicit import Implicit
from .jumps import find_discontinuity, find_jump
from .method import AbstractMethod, ExpRosenbrock
from .nonfinite import first_bad
from .piecewise.method import PiecewiseLinear
from .results import RESULTS
from .runge_kutta import DormandPrince
from .stopped import LAST_STEPS, Diagnosis, Stop

_MAX_RTOL = 0.01
"""Largest rtol that a fix proposes."""
_OVERFLOWS = 1e100
"""|x| beyond which a run ends because numbers overflow, and not because f, h or K are at fault."""
_MAX_DENSE_LAW = 64
"""Largest number of unknowns for which the derivative of the law is formed as a matrix."""
_STABILITY_LIMIT = 3.0
"""The largest stable step times the modulus of a negative eigenvalue: 2 to 3.3, depending on the
method."""
_MAX_ROSENBROCK = 400
"""Largest number of unknowns for which a fix proposes `ExpRosenbrock` for a stiff problem."""
_MIN_ATTEMPTS = 100
"""Smallest number of attempts from which the number of remaining steps is extrapolated."""
_MANY_TIMES = 16
"""More steps than this many times those so far are not the first advice."""
_LATER = 1e-3
"""Share of the run after which K is looked at again where it becomes empty."""

_REFUSED = "refused: "
_OF_X = ("A x", "h", "f")
_NEAREST = "the point of K nearest to 0"
_CHECKED = {name: f"Check {name} there" for name in ("K", "h", "f")} | {
    "A x": "Check A, and how large x becomes",
    _NEAREST: "Check the numbers that K is made of: some of its conditions contradict others",
    "u": "Check how h depends on u: the law has no solution where nothing bounds it",
}


def failure(solution: Any) -> SolveError:
    """Return the `SolveError` of a failed run: result, cause, time reached and fixes."""
    stats, result = solution.stats, solution.result
    diagnosis = diagnose(solution)
    reached = f"Stopped at t = {float(stats['t']):.17g} after {int(stats['steps'])} steps."
    # A law whose f or h is NaN is not at fault.
    shown = RESULTS.nonfinite if diagnosis.is_nonfinite else result
    parts = ("" if diagnosis.replaces_result else RESULTS[shown], diagnosis.cause, reached)
    return SolveError(" ".join(part for part in parts if part), solution, diagnosis.fixes)


def diagnose(solution: Any) -> Diagnosis:
    """Return the cause of a failure according to the tests of this module, or an empty diagnosis."""
    setup, stats, result = solution.setup, solution.stats, solution.result
    if result == RESULTS.max_events:
        return _max_events(solution)
    if result == RESULTS.event_nonfinite:
        return Diagnosis()
    t, step = float(stats["t"]), float(stats["next_dt"])
    t0, t1 = float(setup.setting["t0"]), float(setup.setting["t1"])
    if not math.isfinite(step) or step <= 0:
        step = setup.setting["dt"] if math.isfinite(setup.setting["dt"]) else (t1 - t0) * 1e-3
    if isinstance(setup.method, Implicit):
        step = t1 - t  # t is the last saved time, and steps after it are not recorded
    steps, rejected = int(stats["steps"]), int(stats["rejected"])
    if isinstance(setup.method, PiecewiseLinear):
        step = (t - t0) / max(steps, 1) or t1 - t0  # its steps are as long as its events are apart
    stop = Stop(
        setup, solution.flow, t, stats["x"], min(float(step), max(t1 - t, 0.0)), steps,
        steps + rejected, ":" not in str(stats.get("method", ":")),
    )  # fmt: skip
    causes: list[Callable[[Stop], Diagnosis]] = []
    at_floor = stop.step <= 64.0 * max(stop.ulp, 5e-324)
    if result != RESULTS.max_steps or at_floor:
        # Overflow is the end of growth.
        overflows = _largest(stop.x) > _OVERFLOWS
        causes += [_escape, _nonfinite] if overflows else [_nonfinite]
    if result == RESULTS.law_unsolved:
        causes += [_law]
    causes += [_escape]
    if result != RESULTS.law_unsolved and result != RESULTS.nonfinite:
        # PiecewiseLinear accepts only code for which these causes are excluded.
        by_steps = not isinstance(setup.method, PiecewiseLinear)
        causes += [find_jump, find_discontinuity] if by_steps else []
        causes += [_resolution, *([_tolerance, _stiff] if by_steps else [])]
    if result == RESULTS.max_steps:
        causes += [_max_steps]
    for cause in causes:
        diagnosis = cause(stop)
        if diagnosis.cause:
            return diagnosis
    return Diagnosis()


def _nonfinite(stop: Stop) -> Diagnosis:
    """Detect the first function among A, P, K, h, f that is not finite in the next steps."""
    flow, problem, args = stop.flow, stop.flow.problem, stop.flow.args
    like = problem.zero_control(stop.x)
    start, velocity = stop.time(stop.t), None
    if not first_bad(stop.x):
        try:
            velocity = stop.velocity(start, stop.x)
        except InputError:
            pass  # K raises at t; the search below reports it
    if velocity is None or first_bad(velocity):
        velocity = _tree.zeros_like(stop.x)

    # Compiled once: each projection and each law may contain loops.
    nearest = jax.jit(lambda s: problem.set_at(s, args).project(like, problem.spaces(stop.x)[1]))
    response = jax.jit(lambda s, x: flow.operator.inverse(flow.rate(s, x, None).y))

    def pieces(ahead: float) -> dict[str, Callable[[], Tree]]:
        s = stop.time(stop.t + ahead)
        x = jtu.tree_map(lambda a, b: a + stop.time(ahead) * b, stop.x, velocity)
        return {
            "A x": lambda: flow.generator.apply(x),
            "K": lambda: problem.set_at(s, args),
            _NEAREST: lambda: nearest(s),
            "h": lambda: problem.h(s, x, like, args),
            "u": lambda: response(s, x),
            "f": lambda: problem.f(s, x, response(s, x), args),
        }

    def bad(name: str, ahead: float) -> str:
        try:
            return first_bad(pieces(ahead)[name](), allow_infinite=name == "K")
        except InputError as refused:
            problem = refused.problems[0]
            return f"{_REFUSED}{problem.place}: got {problem.given}; {problem.rule}"

    far = min(stop.span[1] - stop.t, LAST_STEPS * max(stop.step, 4.0 * stop.ulp))
    offsets = [0.0, *(far * np.geomspace(1e-12, 1.0, 13))] if far > 0 else [0.0]
    last_good = 0.0
    for ahead in offsets:
        for name in pieces(ahead):
            diagnosis = bad(name, ahead)
            if not diagnosis:
                continue
            low, high = last_good, float(ahead)
            while high - low > max(stop.ulp, 1e-9 * high) and high > 0:
                middle = 0.5 * (low + high)
                low, high = (low, middle) if bad(name, middle) else (middle, high)
            at, what = f"at t = {stop.t + high:.12g}", bad(name, high) or diagnosis
            if name == "u" and (cause := _not_monotone(stop)) is not None:
                return cause
            if name in ("K", _NEAREST, "u"):
                # There its numbers differ by more than a rounding, which may be all that is wrong at
                # first: then K is not refused, and has a nearest point, but the law has no solution.
                later = min(high + _LATER * (stop.span[1] - stop.span[0]), stop.span[1] - stop.t)
                if later > high and (found := _first(bad, ("K", _NEAREST), later)):
                    (name, what), at = found, f"from {at[3:]} on"
            fixes = (Fix("", "", _CHECKED[name]),)
            if what.startswith(_REFUSED):
                return Diagnosis(f"{name} is refused {at}: {what[len(_REFUSED) :]}.", fixes, True)
            if name == _NEAREST:
                return Diagnosis(f"K is empty {at}: {name} is {what}.", fixes, True)
            x = _tree.add(stop.x, _tree.scale(stop.time(high), velocity))
            where = f"{at}, x = {_tree.short(x)}" if name in _OF_X else at
            return Diagnosis(f"{name} is {what} {where}.", fixes, is_nonfinite=name in ("h", "f"))
        last_good = float(ahead)
    return Diagnosis()


def _first(
    bad: Callable[[str, float], str], names: tuple[str, ...], ahead: float
) -> tuple[str, str] | None:
    """Return the first name of what is bad then, and how; None where nothing is."""
    return next(((name, what) for name in names if (what := bad(name, ahead))), None)


def _escape(stop: Stop) -> Diagnosis:
    """Detect a finite-time escape (|x'| grows as |x|^p with p > 1), or exponential growth."""
    size, first = _largest(stop.x), _largest(stop.setup.x0)
    if not size > 10.0 * (1.0 + first):
        return Diagnosis()
    t0, t1 = stop.span
    grown = f"|x| has grown from {first:.6g} to {size:.6g} at t = {stop.t:.12g}"
    v = stop.velocity(stop.time(stop.t), stop.x)
    speed = _largest(v)
    if math.isfinite(size) and math.isfinite(speed) and speed > 0:
        scale = size / speed

        def power_of(share: float) -> float:
            """Return p, from x' at a state that is larger by this share, at the same t.

            (At a later t, a growing input would be mistaken for an escape.)
            """
            later = jtu.tree_map(lambda a, b: a + stop.time(share * scale) * b, stop.x, v)
            larger, faster = _largest(later), _largest(stop.velocity(stop.time(stop.t), later))
            grows = larger > size and faster > 0
            return math.log(faster / speed) / math.log(larger / size) if grows else 0.0

        power = power_of(1e-4)
        if power > 1.05 and abs(power_of(0.3) - power) < 0.1 * power:
            left = scale / max(power - 1.0, 1e-300)
            if stop.t + left < t1 and left < 0.05 * (stop.t - t0):
                at = stop.t + left
                return Diagnosis(
                    f"{grown}, and its rate grows like |x|^{power:.3g}: a finite-time escape. The "
                    f"solution becomes infinite at t ≈ {at:.6g} and exists up to there only.",
                    (
                        Fix("t1", f"{t0 + 0.99 * (at - t0):.6g}", "to end before the escape"),
                        Fix("", "", "Check the signs in f if x should stay bounded"),
                    ),
                )
    if size > 1e15 * (1.0 + first):
        at_rate = ""
        if first > 0 and math.isfinite(size):  # else no mean rate is defined
            rate = (math.log(size) - math.log(first)) / max(stop.t - t0, 1e-300)
            at_rate = f", at the mean rate {rate:.3g} per unit of time"
        return Diagnosis(
            f"{grown}: exponential growth{at_rate}.",
            (Fix("", "", "Check the signs in A and f if x should stay bounded"),),
            size > _OVERFLOWS,
        )
    return Diagnosis()


def _largest(x: Tree) -> float:
    """Return max |xᵢ|, which overflows later than a norm."""
    return float(max(np.max(np.abs(np.asarray(leaf))) for leaf in jtu.tree_leaves(x)))


def _resolution(stop: Stop) -> Diagnosis:
    """Detect steps of the size of the spacing of floating-point numbers at t."""
    t0, t1 = stop.span
    if not (stop.ulp > 0 and stop.step <= 64.0 * stop.ulp and stop.ulp > 1e-14 * (t1 - t0)):
        return Diagnosis()
    shift = "Count time from the start of the run, so that |t| is not large against t1 − t0"
    longer = (
        "Use double precision: jax.config.update('jax_enable_x64', True) before anything else, and "
        "x0 of float64"
    )
    is_short = jnp.finfo(stop.setup.dtype).bits < 64
    # A shift of time gains nothing where the run is as long as t is large.
    gains = abs(t0) > 0.1 * (t1 - t0)
    fixes = [Fix("", "", text) for text, helps in ((longer, is_short), (shift, gains)) if helps]
    return Diagnosis(
        f"The steps ({stop.step:.3g}) are as small as the rounding of t ({stop.ulp:.3g} at "
        f"t = {stop.t:.12g}).",
        tuple(fixes) or (Fix("", "", "Solve in pieces whose time begins at 0"),),
    )


def _tolerance(stop: Stop) -> Diagnosis:
    """Detect a tolerance below the rounding error of f̃."""
    rtol, atol, horizon = (float(stop.setup.setting[n]) for n in ("rtol", "atol", "horizon"))
    if math.isfinite(stop.setup.setting["dt"]):
        return Diagnosis()
    size = stop.norm(stop.x)
    rate = stop.norm(stop.flow.rate(stop.time(stop.t), stop.x, None).value)
    eps = float(jnp.finfo(stop.setup.dtype).eps)
    required, possible = (atol + rtol * size) / horizon, 16.0 * eps * max(rate, size / horizon)
    if not required < possible:
        return Diagnosis()
    reachable = 100.0 * possible * horizon / max(size, 1e-300)
    speed, (t0, t1) = stop.norm(stop.velocity(stop.time(stop.t), stop.x)), stop.span
    if speed * (t1 - t0) > 1e9 * (1.0 + size) and stop.t - t0 < 1e-9 * (t1 - t0):
        return Diagnosis(
            f"x' is {speed:.3g} next to t = {t0:.12g} while x is {size:.3g}.",
            (Fix("", "", "Check whether f or h is infinite at the start of the run"),),
        )
    fix = Fix("rtol", f"{reachable:.1g}", "which rounding allows")
    if reachable > _MAX_RTOL:
        fix = Fix("t1", f"{stop.span[0] + horizon * _MAX_RTOL / reachable:.3g}", "a shorter run")
    return Diagnosis(
        f"The tolerance requires a defect below (atol + rtol |x|)/horizon = {required:.3g}, and the "
        f"rounding of f alone is {possible:.3g}.",
        (fix,),
    )


def _stiff(stop: Stop) -> Diagnosis:
    """Detect stiffness: h λ is of order one for the eigenvalue λ of largest modulus, while x changes
    slowly."""
    method = stop.setup.method
    if not isinstance(method, AbstractMethod) or method.is_rosenbrock:
        return Diagnosis()
    is_explicit_in_A = isinstance(method, DormandPrince)
    rate_of = stop.velocity if is_explicit_in_A else lambda t, x: stop.flow.rate(t, x, None).value
    t = stop.time(stop.t)
    jvp = jax.jit(lambda v: jax.jvp(lambda x: rate_of(t, x), (stop.x,), (v,))[1])
    space = stop.flow.state_space(stop.x)
    # Start the power iteration from a fixed vector that is unlikely to miss an eigenvector.
    v = jtu.tree_map(
        lambda leaf: jnp.cos(1.0 + jnp.arange(leaf.size, dtype=leaf.dtype)).reshape(leaf.shape),
        stop.x,
    )
    rate, sign = 0.0, 0.0
    for _ in range(30):
        v = _tree.scale(1.0 / space.norm(v), v)
        w = jvp(v)
        rate, sign = stop.norm(w), float(space.inner(v, w))
        if not (math.isfinite(rate) and rate > 0):
            return Diagnosis()
        v = w
    t0, t1 = stop.span
    own = stop.norm(stop.velocity(t, stop.x)) / max(stop.norm(stop.x), 1e-300)
    # Report stiffness if the steps are at the stability limit, or if more steps of that length remain
    # than there were so far.
    at_limit = rate * max(stop.step, (stop.t - t0) / max(stop.steps, 1)) > 0.3
    left = rate * (t1 - stop.t) / _STABILITY_LIMIT
    if not (sign < 0 and rate * (t1 - t0) > 1e3 and own < 0.1 * rate):
        return Diagnosis()
    if not (at_limit or left > stop.attempts):
        return Diagnosis()
    is_large = sum(leaf.size for leaf in jtu.tree_leaves(stop.x)) > _MAX_ROSENBROCK
    what = "Ax + f" if is_explicit_in_A else "f"
    return Diagnosis(
        f"The problem is stiff for {type(method).__name__}: {what} has an eigenvalue of about "
        f"{-rate:.3g}, so that a stable step is at most about {_STABILITY_LIMIT / rate:.2g}, while x "
        f"itself changes at the rate {own:.3g}. From here to t1 that is {left:.2g} steps at least.",
        (Fix("method", "Implicit" if is_large else "ExpRosenbrock", "which is stable there"),),
    )


def _max_events(solution: Any) -> Diagnosis:
    """Report the last interval between two events, which shows whether they accumulate."""
    times = np.asarray(solution.events.ts)
    apart = f", the last two {times[-1] - times[-2]:.3g} apart" if len(times) > 1 else ""
    text = f"Number of events: {len(times)}{apart}."
    fixes = (
        Fix("max_events", f"{4 * len(times)}", "if there are more of them"),
        Fix("", "", "If they accumulate (Zeno's paradox), end the run before by a terminal event"),
    )
    return Diagnosis(text, fixes)


def _max_steps(stop: Stop) -> Diagnosis:
    """Report the number of steps, and an estimate of the number that the run needs."""
    t0, t1 = stop.span
    horizon = float(stop.setup.setting["horizon"])
    # In a run solved in pieces, the user did not choose the end of this piece, and max_steps must
    # suffice for later pieces too.
    is_piece = horizon > 1.000001 * (t1 - t0)
    far = horizon if is_piece else t1 - stop.t
    left = far / max(stop.step, 5e-324)
    text = f"max_steps = {stop.attempts} attempts were used" + (
        f" from t = {t0:.6g} to t = {stop.t:.6g} of a run of the length {horizon:.6g}, with a last "
        if is_piece
        else f", with t1 = {t1:.12g} still {t1 - stop.t:.3g} away and a last "
    )
    method = stop.setup.method
    rtol, atol = (float(stop.setup.setting[name]) for name in ("rtol", "atol"))
    text += f"step of {stop.step:.3g}."
    adaptive = isinstance(method, AbstractMethod) and not math.isfinite(stop.setup.setting["dt"])
    if adaptive:
        text += (
            f" {type(method).__name__}, of order {method.order}, is limited by the tolerance "
            f"(rtol = {rtol:.3g}, atol = {atol:.3g}): one 100 times as "
            f"large needs about {100 ** (1 / method.order):.2g} times fewer steps."
        )
    # After a few steps the extrapolation is unreliable, so use a larger factor.
    enough = 2.0 * stop.attempts + (1.5 if stop.attempts >= _MIN_ATTEMPTS else 10.0) * left
    if isinstance(stop.setup.method, PiecewiseLinear):
        # Its events may all lie at the start, for example when a circuit is switched on.
        enough = min(enough, 100.0 * stop.attempts)
    option, looser = ("rtol", min(_MAX_RTOL, 100 * rtol)) if rtol > 0 else ("atol", 100 * atol)
    looser = Fix(option, f"{looser:.1g}", "for longer steps")
    if enough >= 2**31:
        other = Fix("method", "ExpRosenbrock", "whose steps may be longer")
        if isinstance(method, ExpRosenbrock):
            other = Fix("", "", "Or see where the steps become short: a law that is steeper than "
                        "needed, or a jump, needs a step for each of its kinks")  # fmt: skip
            return Diagnosis(text, (looser, other))
        return Diagnosis(text, (other, looser))
    fixes = [Fix("max_steps", f"{_rounded_up(enough)}", "at this pace")]
    if adaptive and stop.is_method_named:
        fixes += [Fix("", "", "Omit method=, so that dvax chooses one for this problem")]
    if adaptive and enough > _MANY_TIMES * stop.attempts:
        # Many times the work so far is the last thing to try.
        fixes = [*fixes[1:], looser, fixes[0]]
    return Diagnosis(text, tuple(fixes))


def _rounded_up(count: float) -> int:
    """Return the count to two digits."""
    unit = 10 ** max(math.floor(math.log10(count)) - 1, 0)
    return math.ceil(count / unit) * unit


_SIGN = Fix("", "", "Check the sign of the way in which h depends on u")
_REGULARISE = Fix("", "", "Subtract ε u from h, with a small ε > 0: then the law has one solution")

_ZERO = 1e-12
"""Eigenvalues of this size, relative to the largest, are zero up to roundoff."""


def _law(stop: Stop) -> Diagnosis:
    """Return why the law was not solved."""
    cause = _not_monotone(stop)
    if cause is not None:
        return cause
    return Diagnosis(
        f"The solver of the law did not reach its tolerance at t = {stop.t:.12g}.",
        (
            Fix("vi_solver", "Extragradient", "or another solver of dvax.vi with more iterations"),
            _SIGN,
        ),
    )


def _not_monotone(stop: Stop) -> Diagnosis | None:
    """Detect a law F(y) = P⁻¹y − h(t, x, P⁻¹y) that is not strongly monotone at the last state."""
    problem, args, t = stop.flow.problem, stop.flow.args, stop.time(stop.t)
    at = f"at t = {stop.t:.12g}"
    y = stop.flow.rate(t, stop.x, None).y
    like = problem.zero_control(stop.x)
    if y is None or first_bad(y):
        y = like
    flat, unravel = jax.flatten_util.ravel_pytree(y)
    if flat.size <= _MAX_DENSE_LAW:
        F = problem.frozen(t, stop.x, args)
        M = np.asarray(jax.jacfwd(lambda v: jax.flatten_util.ravel_pytree(F(unravel(v)))[0])(flat))
        if np.isfinite(M).all():
            values = np.linalg.eigvalsh(0.5 * (M + M.T))
            least, largest = float(values[0]), float(np.max(np.abs(values)))
            law = (
                f"F(y) = P⁻¹y − h(t, x, P⁻¹y) is not strongly monotone {at}: the symmetric part of "
            )
            if abs(least) <= _ZERO * largest:
                return Diagnosis(
                    f"{law}its derivative has the eigenvalue 0 up to roundoff, so that the law may "
                    "have no solution or several.",
                    (_REGULARISE, _SIGN),
                )
            if least < 0:
                return Diagnosis(
                    f"{law}its derivative has the eigenvalue {least:.6g} < 0, so that the law may have "
                    "no solution or several.",
                    (_SIGN,),
                )
    return None
