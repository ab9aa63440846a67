"""Nonlinear laws on a million intervals: evaluations of F, and time in sweeps over memory."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..clock import in_turn, spread, timed
from ..layout import duration
from ..section import Comparison, Section, Table, Target, compare

_POINTS = 10**6
_TARGET_EVALUATIONS = 15
_OFF = (0.0, 1e-8, 1e-5, 1e-3)
"""How far the guesses of warm starts are from the solution."""


class Law(NamedTuple):
    """F(y) = rule(y, c) on [lower, upper], c uniform in `drive`; no target where `steep` (no L_F)."""

    name: str
    rule: Callable[[Any, Any], Any]
    lower: float
    upper: float
    drive: tuple[float, float]
    steep: bool = False


_LAWS = (
    Law("y + y³ − c", lambda y, c: y + y**3 - c, -2.0, 2.0, (-12.0, 12.0)),
    Law("(2 + sin y)(y − c)", lambda y, c: (2 + jnp.sin(y)) * (y - c), 0.0, 4.7, (-2.0, 7.0)),
    Law("exp y − c", lambda y, c: jnp.exp(y) - c, -3.0, 3.0, (-2.0, 25.0)),
    Law("log y + y − c", lambda y, c: jnp.log(y) + y - c, 1e-6, 10.0, (-16.0, 16.0)),
    Law("y + tanh 5y − c", lambda y, c: y + jnp.tanh(5 * y) - c, -2.0, 2.0, (-4.0, 4.0)),
    Law(
        "tanh 10(y − c) + (y − c)/10",
        lambda y, c: jnp.tanh(10 * (y - c)) + 0.1 * (y - c), 0.0, 10.0, (-3.0, 13.0),
    ),
    Law("arctan 10³(y − c)", lambda y, c: jnp.arctan(1e3 * (y - c)), 0.0, 10.0, (-3.0, 13.0)),
    Law("y + y³ − c on R", lambda y, c: y + y**3 - c, -np.inf, np.inf, (-1e3, 1e3)),
    Law("exp y − 1 − c, y ≥ 0", lambda y, c: jnp.expm1(y) - c, 0.0, np.inf, (-5.0, 1e3)),
    Law(
        "y + 50 tanh 50y − c",
        lambda y, c: y + 50 * jnp.tanh(50 * y) - c, -2.0, 2.0, (-70.0, 70.0),
    ),
    Law(
        "±√|y − c| + (y − c)/100",
        lambda y, c: jnp.sign(y - c) * jnp.sqrt(jnp.abs(y - c)) + 0.01 * (y - c),
        0.0, 1.0, (-0.3, 1.3), True,
    ),
)  # fmt: skip


def run(full: bool) -> Section:
    table = Table(
        f"Evaluations of F for all {_POINTS:.0e} points together, a slope with each",
        ("law", "from 0", *(f"guess off by {off:g}" for off in _OFF), "residual", "all solved",
         "solve", "F", "F and F′", "copy", "solve/copy", "solve/(F and F′)"),
        [],
    )  # fmt: skip
    section = Section(
        title=f"pointwise: {_POINTS:.0e} intervals, a nonlinear law each",
        fair=(
            "No peer solves many scalar inequalities at once; the yardsticks are one jitted sweep "
            "of F over the points, one of F with its slope, and one of y + 1, which is a copy. The "
            "solver is Bracketing, under jax.jit, c an argument, certificate not included; the "
            "count is the evaluations of F until the last point is enclosed, the slope of each "
            "not counted. Between a third and a half of the points end on a bound where there are "
            "bounds. The last law has an infinite slope at every "
            "solution and is there to show the worst: it has no target."
        ),
        tables=[table],
    )
    rng = np.random.default_rng(0)
    for law in _LAWS:
        _measure(section, table, law, rng, 9 if full else 3)
    return section


def _measure(
    section: Section, table: Table, law: Law, rng: np.random.Generator, rounds: int
) -> None:
    c = jnp.asarray(rng.uniform(*law.drive, _POINTS))
    zero = jnp.zeros(_POINTS)
    space = dvax.spaces.Euclidean(_POINTS)

    @jax.jit
    def solve(c: Any, y0: Any) -> Any:
        vi = dvax.vi.FrozenVI(lambda y: law.rule(y, c), dvax.sets.Box(law.lower, law.upper), space)
        answer = dvax.vi.Bracketing().solve(vi, y0, 0.0)
        solved = answer.result == dvax.vi.RESULTS.successful
        return answer.y, answer.evaluations, answer.residual, solved

    @jax.jit
    def with_slope(y: Any, c: Any) -> Any:
        return jax.jvp(lambda y: law.rule(y, c), (y,), (jnp.ones_like(y),))

    y, count, residual, solved = solve(c, zero)
    warm = [int(solve(c, y + off * rng.uniform(-1.0, 1.0, _POINTS))[1]) for off in _OFF]
    sweep, copy = jax.jit(law.rule), jax.jit(lambda y: y + 1.0)
    sides = {"solve": (solve, c, zero), "F": (sweep, y, c), "F and F′": (with_slope, y, c),
             "copy": (copy, y)}  # fmt: skip
    taken = in_turn(
        {
            name: timed(functools.partial(lambda f, *a: jax.block_until_ready(f(*a)), *side))
            for name, side in sides.items()
        },
        rounds,
    )
    against_copy = compare("", "", taken["solve"], taken["copy"]).ratio
    against_slope = compare("", "", taken["solve"], taken["F and F′"]).ratio
    assert against_copy is not None and against_slope is not None
    table.rows.append(
        (
            law.name,
            str(int(count)),
            *map(str, warm),
            f"{float(residual):.0e}",
            "yes" if bool(solved) else "NO",
            *(duration(spread(taken[name]).middle) for name in sides),
            f"{against_copy.middle:.0f}",
            f"{against_slope.middle:.0f}",
        )
    )
    section.comparisons.append(
        Comparison(
            law.name,
            "evaluations of F",
            spread(taken["solve"]).middle,
            None,
            target=None
            if law.steep
            else Target("≤", _TARGET_EVALUATIONS, int(count), " evaluations"),
            rounds=rounds,
        )
    )
