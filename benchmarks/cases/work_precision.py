"""Time to a given error on three small systems and on the heat equation, beside general tools."""

import contextlib
import functools
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import dvax

from ..clock import Sample, in_turn, spread, timed
from ..layout import duration
from ..peers import casadi_idas
from ..peers.siconos_client import SiconosRaces, python
from ..races import Race, contact, heat, moving_box, shrinking_ball
from ..section import Section, Table, compare

_LEVELS = (1e-4, 1e-6, 1e-8, 1e-10)
_TOLERANCES = [10.0 ** (-k / 2) for k in range(2, 27)]
_STEPS = [round(10.0 ** (k / 2)) for k in range(2, 13)]
_LONGEST = {False: 2.0, True: 10.0}
"""Seconds after which a tool is not asked for more digits, in a short and in a full run."""
_ENOUGH = 20.0
"""Seconds of rounds at one level, after which three rounds are enough."""
_MAX_STEPS = 10**6
_OURS = "dvax"
_WANTED = {"scipy": 10.0, "Diffrax": 1.0, "Siconos": 10.0, "CasADi": 10.0}
"""How many times faster dvax is to be than each tool on a small system; on the finest field 5."""


class Entrant(NamedTuple):
    """setting -> x(end) at settings that grow tighter (rtol, or a number of steps), and how a solve is
    timed: `timed` unless the tool runs in a process of its own."""

    solve: Callable[[float], Any]
    settings: list[float] = _TOLERANCES
    sample: Callable[[float], Sample] | None = None

    def timed(self, setting: float) -> Sample:
        return self.sample(setting) if self.sample else timed(lambda: self.solve(setting))


class Tool(NamedTuple):
    """An entrant, the seconds that its first call took, and its errors."""

    entrant: Entrant
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
            "as arguments; scipy calls NumPy. scipy and Diffrax have their law solved by hand. "
            "CasADi's IDAS is given the natural map of the law as an algebraic equation, its "
            "integrators made beforehand. Siconos steps by θ = γ = ½ with a relay of all unknowns, "
            "projected Gauss-Seidel to 1e-13, data in time tabulated beforehand, and its stepping "
            "alone is timed; its settings are half decades of steps from 10. A ball is no relay."
        ),
    )
    sizes = (64, 512, 4096) if full else (64,)
    makers = [contact, moving_box, shrinking_ball, *(functools.partial(heat, n) for n in sizes)]
    with contextlib.ExitStack() as stack:
        siconos = None
        if (interpreter := python()) is not None:
            siconos = stack.enter_context(SiconosRaces(interpreter))
        else:
            section.notes.append("No Python here imports siconos.kernel: Siconos is left out.")
        if not casadi_idas.present():
            section.notes.append("CasADi is not installed here (pip install casadi): left out.")
        for make in makers:
            race = make()
            _race(section, race, _entrants(race) | _others(race, siconos), full)
    return section


def _race(section: Section, race: Race, entrants: dict[str, Entrant], full: bool) -> None:
    tools: dict[str, Tool] = {}
    print(f"work and precision: {race.name}", file=sys.stderr, flush=True)
    for name, entrant in entrants.items():
        started = time.perf_counter()
        entrant.solve(entrant.settings[0])
        tools[name] = Tool(
            entrant, time.perf_counter() - started, _errors(race, entrant, _LONGEST[full])
        )
    rows = []
    for level in _LEVELS:
        settings = {name: _loosest(tool.errors, level) for name, tool in tools.items()}
        able = {name: setting for name, setting in settings.items() if setting is not None}
        samples = {name: tools[name].entrant.timed(setting) for name, setting in able.items()}
        taken = in_turn(samples, 11 if full else 5, enough=_ENOUGH)
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


def _entrants(race: Race) -> dict[str, Entrant]:
    field = race.x0.size >= 64
    methods = [dvax.ETD2RK(), dvax.ETD4RK(), *([] if field else [dvax.ExpRosenbrock()])]
    if race.x0.size <= 64:
        methods.append(dvax.DormandPrince())
    out = {f"dvax {type(m).__name__}": _ours(race, m) for m in methods}
    solvers = [diffrax.Tsit5(), diffrax.Kvaerno5()]
    # An explicit method needs as many steps as the norm of A says, an implicit one a full matrix.
    if race.x0.size > 512:
        solvers = []
    out |= {f"Diffrax {type(s).__name__}": _diffrax(race, s) for s in solvers}
    names = ["LSODA", "Radau"] if race.x0.size > 64 else ["DOP853", "LSODA", "Radau"]
    out |= {f"scipy {name}": _scipy(race, name) for name in names}
    return {name: Entrant(solve) for name, solve in out.items()}


def _others(race: Race, siconos: SiconosRaces | None) -> dict[str, Entrant]:
    """The peers that write the law themselves."""
    out: dict[str, Entrant] = {}
    if casadi_idas.present():
        out["CasADi IDAS"] = Entrant(casadi_idas.idas(casadi_idas.SYSTEMS[race.key](race.x0.size)))
    # Siconos's linear algebra is dense.
    if siconos is not None and race.key in SiconosRaces.names and race.x0.size <= 512:
        run = functools.partial(siconos.run, race.key, race.x0.size)
        out["Siconos"] = Entrant(
            lambda steps: run(round(steps))[1], [float(n) for n in _STEPS],
            lambda steps: lambda: run(round(steps))[0],
        )  # fmt: skip
    return out


def _ours(race: Race, method: Any) -> Callable[[float], Any]:
    @jax.jit
    def solve(x0: Any, rtol: Any) -> Any:
        return dvax.solve(
            race.problem, x0, 0.0, race.end, rtol=rtol, atol=1e-3 * rtol, method=method,
            max_steps=_MAX_STEPS,
        ).xs[-1]  # fmt: skip

    x0 = jnp.asarray(race.x0)
    return lambda rtol: jax.block_until_ready(solve(x0, rtol))


def _diffrax(race: Race, solver: Any) -> Callable[[float], Any]:
    term = diffrax.ODETerm(lambda t, x, _: race.field(t, x, jnp))

    @jax.jit
    def solve(x0: Any, rtol: Any) -> Any:
        answer = diffrax.diffeqsolve(
            term, solver, 0.0, race.end, None, x0, max_steps=_MAX_STEPS, throw=False,
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


def _errors(race: Race, entrant: Entrant, longest: float) -> list[tuple[float, float]]:
    """(setting, error), tightest last, until the error has twice been below the last level."""
    found: list[tuple[float, float]] = []
    for setting in entrant.settings:
        started = time.perf_counter()
        found.append((setting, race.error(entrant.solve(setting))))
        last = [error for _, error in found[-2:]]
        if max(last) < 0.5 * _LEVELS[-1] or time.perf_counter() - started > longest:
            break
    return found


def _loosest(found: list[tuple[float, float]], level: float) -> float | None:
    best = None
    for setting, error in reversed(found):
        if error > level:
            break
        best = setting
    return best
