"""One small system (C1) to errors of 1e-6 and 1e-9, by dvax and by general ODE solvers."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp

import dvax

from .. import compiled
from ..clock import in_turn, timed
from ..contact_law import single
from ..peers import clipped_diffrax, clipped_scipy
from ..section import Section, compare

_END = 2.0
_LEVELS = (1e-6, 1e-9)
_TOLERANCES = [10.0 ** (-k / 2) for k in range(4, 27)]
_STEPS = [2**k for k in range(4, 18)]
_FINEST = 2**20
_REFERENCE = "dvax ETD4RK, jax.jit"


class Choice(NamedTuple):
    """The loosest setting that suffices, and the error it leaves."""

    setting: float
    error: float


def run(full: bool) -> Section:
    law = single()
    start = jnp.asarray(law.start)
    stepping = compiled.fixed(_END, _FINEST)
    adapting = compiled.adaptive(_END)
    fourth = compiled.adaptive(_END, dvax.ETD4RK())
    tools: dict[str, tuple[Callable[[float], Any], list[float]]] = {
        _REFERENCE: (lambda rtol: fourth(law.model, start, rtol, 1e-3 * rtol), _TOLERANCES),
        "dvax ETD2RK, jax.jit": (
            lambda rtol: adapting(law.model, start, rtol, 1e-3 * rtol),
            _TOLERANCES,
        ),
        "dvax ETD2RK, as called": (
            lambda rtol: compiled.called(law.model, start, _END, rtol=rtol, atol=1e-3 * rtol),
            _TOLERANCES,
        ),
        "dvax fixed steps, jax.jit": (
            lambda dt: stepping(law.model, start, dt),
            [_END / count for count in _STEPS],
        ),
        "Diffrax Tsit5": (clipped_diffrax.solver(law, diffrax.Tsit5(), _END), _TOLERANCES),
        "Diffrax Dopri8": (clipped_diffrax.solver(law, diffrax.Dopri8(), _END), _TOLERANCES),
        **{
            f"scipy {name}": (clipped_scipy.solver(law, name, _END), _TOLERANCES)
            for name in ("LSODA", "DOP853", "Radau")
        },
    }
    section = Section(
        title="tools: C1, one point and two kinks, to a given error at t = 2",
        fair=(
            "Every tool runs at the loosest of its settings (rtol in half decades from 1e-2 to "
            "1e-13, atol = rtol/1000; fixed steps in powers of two) whose achieved error, like "
            "that of every tighter setting tried, is at most the level. Diffrax is under jax.jit "
            "with the end saved alone and parameters and tolerance as arguments; scipy's "
            "right-hand side is plain Python arithmetic, faster than numpy on one entry. Their clip is "
            "written by hand and they certify nothing; dvax measures its defect in every adaptive "
            "step. No target is set yet."
        ),
    )
    errors = {name: _errors(law, solve, settings) for name, (solve, settings) in tools.items()}
    for level in _LEVELS:
        chosen = {name: _loosest(found, level) for name, found in errors.items()}
        missed = [name for name, choice in chosen.items() if choice is None]
        if missed:
            section.notes.append(f"Not reached within {level:g}: {', '.join(missed)}.")
        able = {name: choice for name, choice in chosen.items() if choice is not None}
        if _REFERENCE not in able:
            continue
        samples = {
            name: timed(functools.partial(tools[name][0], choice.setting))
            for name, choice in able.items()
        }
        taken = in_turn(samples, 21 if full else 9)
        section.comparisons += [
            compare(
                f"error ≤ {level:g}, {_REFERENCE}, rtol {able[_REFERENCE].setting:.0e}",
                f"{name}, {'dt' if 'fixed' in name else 'rtol'} {choice.setting:.1e}",
                taken[_REFERENCE],
                taken[name],
                direction="other/dvax",
                error=able[_REFERENCE].error,
                error_other=choice.error,
            )
            for name, choice in able.items()
            if name != _REFERENCE
        ]
    return section


def _errors(
    law: Any, solve: Callable[[float], Any], settings: list[float]
) -> list[tuple[float, float]]:
    """(setting, error), tightest last. Below 1e-12 everything is rounding, so it ends there."""
    found: list[tuple[float, float]] = []
    for setting in settings:
        error = law.error(solve(setting), _END)
        found.append((setting, error if math.isfinite(error) else math.inf))
        if len(found) > 1 and max(found[-1][1], found[-2][1]) < 0.1 * _LEVELS[-1]:
            break
    return found


def _loosest(found: list[tuple[float, float]], level: float) -> Choice | None:
    best: Choice | None = None
    for setting, error in reversed(found):
        if error > level:
            break
        best = Choice(setting, error)
    return best
