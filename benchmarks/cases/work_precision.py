"""Time to a given error on three small systems and on the heat equation, beside general tools."""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import dvax

from ..clock import in_turn, spread, timed
from ..layout import duration
from ..races import Race, contact, heat, moving_box, shrinking_ball
from ..section import Section, Table, compare

_LEVELS = (1e-4, 1e-6, 1e-8, 1e-10)
_TOLERANCES = [10.0 ** (-k / 2) for k in range(2, 27)]
_LONGEST = 20.0
"""Seconds after which a tool is not asked for more digits."""
_MOST = 10**6
_OURS = "dvax"
_WANTED = {"scipy": 10.0, "Diffrax": 1.0}
"""How many times faster dvax is to be than each tool on a small system; on the finest field 5."""


class Tool(NamedTuple):
    """rtol -> x(end); `first` is the time of the first call."""

    solve: Callable[[float], Any]
    first: float
    errors: list[tuple[float, float]]


def run(full: bool) -> Section:
    section = Section(
        title="work and precision: time to a given error",
        fair=(
            "Every tool runs at the loosest rtol (half decades from 0.1, atol = rtol/1000) whose "
            "achieved error, like that of every tighter rtol tried, is at most the level. Of the "
            "methods of dvax, as of those of a peer, the fastest counts in the comparison; the table "
            "shows all. dvax and Diffrax are under jax.jit, the end saved alone, with x(0) and rtol "
            "as arguments; scipy calls NumPy. Peers have their law solved by hand."
        ),
    )
    sizes = (64, 512, 4096) if full else (64,)
    makers = [contact, moving_box, shrinking_ball, *(functools.partial(heat, n) for n in sizes)]
    for make in makers:
        _race(section, make(), full)
    return section


def _race(section: Section, race: Race, full: bool) -> None:
    tools: dict[str, Tool] = {}
    for name, solve in _entrants(race).items():
        begun = time.perf_counter()
        solve(_TOLERANCES[0])
        tools[name] = Tool(solve, time.perf_counter() - begun, _errors(race, solve))
    rows = []
    for level in _LEVELS:
        settings = {name: _loosest(tool.errors, level) for name, tool in tools.items()}
        able = {name: rtol for name, rtol in settings.items() if rtol is not None}
        samples = {
            name: timed(functools.partial(tools[name].solve, rtol)) for name, rtol in able.items()
        }
        taken = in_turn(samples, 11 if full else 5)
        middle = {name: spread(series).middle for name, series in taken.items()}
        rows.append((f"{level:g}", *(duration(middle[n]) if n in middle else "-" for n in tools)))
        ours = [name for name in middle if name.startswith(_OURS)]
        if not ours:
            section.notes.append(f"{race.name}: dvax does not reach {level:g}.")
            continue
        best = min(ours, key=middle.__getitem__)
        for peer, factor in _WANTED.items():
            theirs = [name for name in middle if name.startswith(peer)]
            if not theirs:
                continue
            other = min(theirs, key=middle.__getitem__)
            wanted = 5.0 if race.x0.size == 4096 else factor if race.x0.size < 64 else 1.0
            row = compare(
                f"{race.name}, error ≤ {level:g}, {best}", other, taken[best], taken[other],
                direction="other/dvax", target=("≥", wanted),
            )  # fmt: skip
            section.comparisons.append(row)
    rows.append(("first call", *(duration(tool.first) for tool in tools.values())))
    section.tables.append(Table(f"{race.name}: time to an error", ("error", *tools), rows))


def _entrants(race: Race) -> dict[str, Callable[[float], Any]]:
    field = race.x0.size >= 64
    methods = [dvax.ETD2RK(), dvax.ETD4RK(), *([] if field else [dvax.ExpRosenbrock()])]
    out = {f"dvax {type(m).__name__}": _ours(race, m) for m in methods}
    solvers = [diffrax.Tsit5(), diffrax.Kvaerno5()]
    # An explicit method needs as many steps as the norm of A says, an implicit one a full matrix.
    if race.x0.size > 512:
        solvers = []
    out |= {f"Diffrax {type(s).__name__}": _diffrax(race, s) for s in solvers}
    names = ["LSODA", "Radau"] if race.x0.size > 64 else ["DOP853", "LSODA", "Radau"]
    return out | {f"scipy {name}": _scipy(race, name) for name in names}


def _ours(race: Race, method: Any) -> Callable[[float], Any]:
    @jax.jit
    def solve(x0: Any, rtol: Any) -> Any:
        return dvax.solve(
            race.problem, x0, 0.0, race.end, rtol=rtol, atol=1e-3 * rtol, method=method,
            max_steps=_MOST,
        ).xs[-1]  # fmt: skip

    x0 = jnp.asarray(race.x0)
    return lambda rtol: jax.block_until_ready(solve(x0, rtol))


def _diffrax(race: Race, solver: Any) -> Callable[[float], Any]:
    term = diffrax.ODETerm(lambda t, x, _: race.field(t, x, jnp))

    @jax.jit
    def solve(x0: Any, rtol: Any) -> Any:
        answer = diffrax.diffeqsolve(
            term, solver, 0.0, race.end, None, x0, max_steps=_MOST, throw=False,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-3 * rtol),
            saveat=diffrax.SaveAt(t1=True),
        )  # fmt: skip
        assert answer.ys is not None
        return answer.ys[-1]

    x0 = jnp.asarray(race.x0)
    return lambda rtol: jax.block_until_ready(solve(x0, rtol))


def _scipy(race: Race, name: str) -> Callable[[float], Any]:
    how: dict[str, Any] = {}
    if race.banded and name == "LSODA":
        how = dict(lband=1, uband=1)
    if race.banded and name == "Radau":
        n = race.x0.size
        how = dict(jac_sparsity=sum(np.eye(n, k=k) for k in (-1, 0, 1)))

    def solve(rtol: float) -> Any:
        answer = solve_ivp(
            lambda t, x: race.field(t, x, np), (0.0, race.end), race.x0, method=name, rtol=rtol,
            atol=1e-3 * rtol, **how,
        )  # fmt: skip
        return answer.y[:, -1] if answer.success else np.full_like(race.x0, np.nan)

    return solve


def _errors(race: Race, solve: Callable[[float], Any]) -> list[tuple[float, float]]:
    """(rtol, error), tightest last, until the error has twice been below the last level."""
    found: list[tuple[float, float]] = []
    for rtol in _TOLERANCES:
        begun = time.perf_counter()
        found.append((rtol, race.error(solve(rtol))))
        last = [error for _, error in found[-2:]]
        if max(last) < 0.5 * _LEVELS[-1] or time.perf_counter() - begun > _LONGEST:
            break
    return found


def _loosest(found: list[tuple[float, float]], level: float) -> float | None:
    best = None
    for rtol, error in reversed(found):
        if error > level:
            break
        best = rtol
    return best
