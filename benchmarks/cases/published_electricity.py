"""The year of RTS-GMLC on its network, in one run, beside linear programmes hour by hour."""

import os
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..clock import in_turn, timed
from ..electric_network import MINUTES, PRICE, Market, Network, market, read_network
from ..layout import duration
from ..peers.dispatch import LinearProgramme, QuadraticProgramme
from ..section import Comparison, Section, Table, Target, compare

FOLDER = "DVAX_RTS"
WEEK = 24 * 182
"""The hour of the data at which the week of the short benchmark begins: 1 July."""
SCALES = (1.0, 0.1, 0.01)
"""Multiples of the slopes a."""
_BLOCKS = 10
_RACE = 288
_STEP = MINUTES / 60 * (1.0 + 1e-9)
"""A step is no shorter than the interval between two rows, whose times have roundoff."""


class Hours(NamedTuple):
    """Dispatch at saved times: `ts`, states `xs`, unknowns `us`, prices of all buses, capacities of the
    units and multipliers of the rows."""

    ts: np.ndarray
    xs: np.ndarray
    us: np.ndarray
    prices: np.ndarray
    capacity: np.ndarray
    multipliers: np.ndarray


def law(case: Market, ts: np.ndarray, xs: np.ndarray) -> Hours:
    """Solve the law at these times and states, one after the other in one program."""
    us, multipliers, upper = map(np.asarray, _laws(case)(jnp.asarray(ts), jnp.asarray(xs)))
    units = case.network.units
    return Hours(ts, xs, us, case.prices(multipliers), upper[:, :units], multipliers)


def _laws(case: Market) -> Callable[[jax.Array, jax.Array], Any]:
    problem = case.problem

    def one(point: tuple) -> tuple:
        t, x = point
        K, space = problem.set_at(t), problem.spaces(x)[1]
        assert isinstance(K, dvax.sets.ConstrainedBox)
        z = problem.h(t, x, problem.zero_control(x), None)
        multipliers = K.multipliers(z, space)
        # The projection, without solving for the multipliers again.
        u = jnp.clip(z - multipliers @ K.R / space.weights(), K.lower, K.upper)
        return u, multipliers, K.upper

    return jax.jit(lambda ts, xs: jax.lax.map(one, (ts, xs)))


def gap(case: Market, hours: Hours) -> np.ndarray:
    """Return Σ aᵢgᵢ(capᵢ − gᵢ), in $/h: a bound of the distance to the linear programme's cost."""
    units = case.network.units
    g = hours.us[:, :units]
    return np.sum(case.weights[:units] * g * (hours.capacity - g), axis=1)


def linear_programmes(
    network: Network, hours: Hours, blocks: int = 0, slope: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, float, str]:
    """Return costs and prices of the linear programmes of all hours, their time, and the solver."""
    programme = LinearProgramme(network, blocks, slope)
    units = network.units
    started = time.perf_counter()
    found = [
        programme.solve(capacity, u[units:-1])
        for capacity, u in zip(hours.capacity, hours.us, strict=True)
    ]
    seconds = time.perf_counter() - started
    costs, prices = (np.array(part) for part in zip(*found, strict=True))
    return costs, prices, seconds, programme.name


def solve(case: Market, ts: np.ndarray, measure: bool) -> dvax.Solution:
    """Solve from no adaptation, a step for every row of the wind."""
    x0 = jnp.zeros(len(case.network.load_bus))
    return dvax.solve(
        case.problem, x0, case.first, case.last, ts=ts, dt=_STEP, constants=case.constants,
        measure=measure, max_steps=2**20,
    )  # fmt: skip


def run(full: bool) -> Section:
    section = Section(
        title="published_electricity: RTS-GMLC with its network",
        fair=(
            "Linear programmes have the demand of dvax, all lines, and angles of the buses instead of "
            "flow factors. HiGHS keeps its basis from hour to hour if highspy is installed. Clarabel "
            "solves the law of dvax at its default tolerances, set up once. Times of dvax are without "
            "compilation. All run on the same cores."
        ),
    )
    folder = os.environ.get(FOLDER)
    if folder is None or not Path(folder).is_dir():
        section.skipped = f"{FOLDER} names no folder with the files of RTS-GMLC"
        return section
    try:
        network = read_network(folder)
    except FileNotFoundError as error:
        section.skipped = str(error)
        return section
    first, last = (0, len(network.load) - 1) if full else (WEEK, WEEK + 168)
    case = market(network, first, last)
    _describe(section, case)
    hours = _run(section, case)
    _hour_by_hour(section, case, hours)
    _limits(section, network)
    # The whole days with the fewest and with the most hours in which a line binds.
    binds = np.any(hours.multipliers[:, 1:] != 0, axis=1)[: 24 * ((last - first) // 24)]
    binding = binds.reshape(-1, 24).sum(axis=1)
    for day in (int(np.argmin(binding)), int(np.argmax(binding))):
        _race(section, case, hours, day, int(binding[day]))
    return section


def _describe(section: Section, case: Market) -> None:
    network, lines = case.network, case.lines
    rows = [
        ("buses, with load", f"{len(network.buses)}, {len(network.load_bus)}"),
        ("units", f"{network.units}"),
        ("unknowns of the law, states", f"{network.unknowns}, {len(network.load_bus)}"),
        ("lines", f"{len(network.limit)}"),
        ("lines proved never to bind", f"{lines.impossible}"),
        ("circuits that a parallel one implies", f"{lines.parallel}"),
        ("rows of the set", f"{1 + len(lines.row)}"),
        ("values of wind power per plant", f"{len(network.wind):,}"),
    ]
    section.tables.append(Table("The network", ("", ""), rows))


def _run(section: Section, case: Market) -> Hours:
    ts = np.arange(case.first, case.last + 1.0)
    rows = []
    for measure in (True, False):
        solution = solve(case, ts, measure)
        compiling = solution.stats["compile_time"]
        seconds = solution.stats["run_time"]
        laws = int(solution.stats["evaluations"])
        bound, worst = "–", "–"
        if measure:
            found = dvax.bound_error(case.problem, solution, case.constants)
            section.notes.append(f"The bound of x in the run is {found.status}.")
            bound = f"{float(found.x.max()):.2g}"
            worst = f"{float(found.x.max()) / np.sqrt(case.beta.min()):.2g}"
        rows.append(
            (
                "with a bound" if measure else "without", f"{case.last - case.first:,.0f}",
                f"{int(solution.stats['steps']):,}", f"{laws:,}", duration(compiling),
                duration(seconds), duration(seconds / laws), bound, worst,
                f"{float(np.max(np.asarray(solution.law_error))):.1e}",
            )
        )  # fmt: skip
    section.tables.append(
        Table(
            "One run, fixed steps of five minutes",
            ("defects", "hours", "steps", "laws", "compilation", "run", "time per law",
             "bound of x, √($/h)", "at any bus, MW", "law, proved"), rows,
        )
    )  # fmt: skip
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    section.notes.append(f"Peak memory of the process after both runs: {peak:,.0f} MiB.")
    fine = change_by_smaller_steps(case)
    section.notes.append(
        f"The first day with steps of a minute differs by at most {fine:.2g} MW in any state."
    )
    return law(case, ts, np.asarray(solution.xs))


def change_by_smaller_steps(case: Market) -> float:
    """Return the largest change of a state in the first day by steps of a fifth."""
    x0, end = jnp.zeros(len(case.network.load_bus)), case.first + 24.0
    ts = np.arange(case.first, end + 1.0)
    coarse, fine = (
        dvax.solve(case.problem, x0, case.first, end, ts=ts, dt=dt).xs for dt in (_STEP, _STEP / 5)
    )
    return float(jnp.max(jnp.abs(coarse - fine)))


def _hour_by_hour(section: Section, case: Market, hours: Hours) -> None:
    network, units = case.network, case.network.units
    binds = hours.multipliers[:, 1:] != 0
    wind = hours.capacity[:, network.is_wind].sum()
    spilled = (hours.capacity - hours.us[:, :units])[:, network.is_wind].sum()
    spread = hours.prices.max(axis=1) - hours.prices.min(axis=1)
    section.tables.append(
        Table(
            "Prices at all buses and hours",
            ("median, $/MWh", "least", "largest", "hours with a line at its limit",
             "lines that bind in some hour", "most lines at once", "largest spread, $/MWh",
             "wind curtailed"),
            [(
                f"{np.median(hours.prices):.4f}", f"{hours.prices.min():.4f}",
                f"{hours.prices.max():.4f}", f"{int(binds.any(axis=1).sum()):,} of {len(binds):,}",
                f"{int(binds.any(axis=0).sum())}", f"{int(binds.sum(axis=1).max())}",
                f"{spread.max():.4f}", f"{spilled / wind:.2%}",
            )],
        )
    )  # fmt: skip
    costs, prices, seconds, name = linear_programmes(network, hours)
    excess = hours.us[:, :units] @ network.cost - costs
    bound = gap(case, hours)
    away = np.abs(hours.prices - prices)
    section.tables.append(
        Table(
            "The same demand by a linear programme without slopes (a = 0), all hours",
            ("hours", "cost of the programmes, $", "cost of dvax − this, $", "at most (proved), $",
             "prices: median |difference|", "largest", "time of the programmes", "solver"),
            [(
                f"{len(costs):,}", f"{costs.sum():,.0f}", f"{excess.sum():,.0f}",
                f"{bound.sum():,.0f}", f"{np.median(away):.3g}", f"{away.max():.3g}",
                duration(seconds), name,
            )],
        )
    )  # fmt: skip
    violation = float(np.max(np.maximum(-excess, excess - bound) / costs.clip(min=1.0)))
    section.comparisons.append(
        Comparison(
            "largest violation of 0 ≤ excess ≤ bound, relative", "", None, None,
            target=Target("≤", 1e-7, max(violation, 0.0)),
        )
    )  # fmt: skip


def _limits(section: Section, network: Network) -> None:
    rows = []
    for scale in SCALES:
        case = market(network, WEEK, WEEK + 168, scale)
        ts = np.arange(case.first, case.last + 1.0)
        hours = law(case, ts, np.zeros((len(ts), len(network.load_bus))))
        g = hours.us[:, : network.units]
        costs, prices, _, _ = linear_programmes(network, hours)
        away = np.abs(hours.prices - prices)
        slope = scale * network.slope
        of_blocks, near, _, _ = linear_programmes(network, hours, _BLOCKS, slope)
        own = g @ network.cost + 0.5 * g**2 @ slope
        chord = np.sum(slope * (hours.capacity / _BLOCKS) ** 2, axis=1) / 8
        rows.append(
            (
                f"{scale:g}", f"{np.mean((g @ network.cost - costs) / costs):.2e}",
                f"{np.mean(gap(case, hours) / costs):.2e}", f"{np.median(away):.2g}",
                f"{np.quantile(away, 0.99):.2g}", f"{np.mean((of_blocks - own) / own):.2e}",
                f"{np.mean(chord / own):.2e}", f"{np.median(np.abs(hours.prices - near)):.2g}",
            )
        )  # fmt: skip
    section.tables.append(
        Table(
            f"Slopes to zero, and {_BLOCKS} blocks of constant cost per unit: a week of hours, x = 0",
            ("slopes ×", "excess over a = 0", "at most (proved)", "prices: median", "99 %",
             "blocks − dvax", "at most (proved)", "prices: median"), rows,
        )
    )  # fmt: skip


def _race(section: Section, case: Market, hours: Hours, day: int, binding: int) -> None:
    network, loads = case.network, len(case.network.load_bus)
    ts = case.first + 24.0 * day + MINUTES / 60 * np.arange(_RACE)
    xs = np.tile(hours.xs[24 * day], (_RACE, 1))
    name = f"{_RACE} laws of a day, lines bind in {binding} hours"
    run, points = _laws(case), (jnp.asarray(ts), jnp.asarray(xs))
    ours = law(case, ts, xs)
    programme = LinearProgramme(network)
    units = network.units
    samples = {
        "dvax": timed(lambda: jax.block_until_ready(run(*points))),
        "lp": timed(
            lambda: [
                programme.solve(c, u[units:-1]) for c, u in zip(ours.capacity, ours.us, strict=True)
            ]
        ),
    }
    position = units + np.arange(loads)
    target = np.array([case.problem.h(t, x, None, None)[position] for t, x in zip(ts, xs)])
    target -= PRICE / case.beta
    others: list[np.ndarray] = []
    try:
        quadratic = QuadraticProgramme(network, case.weights)

        def clarabel() -> None:
            others[:] = [quadratic.solve(c, d) for c, d in zip(ours.capacity, target, strict=True)]

        samples["clarabel"] = timed(clarabel)
    except ImportError:
        section.notes.append("Clarabel is not installed.")
    taken = in_turn(samples, 5, enough=60.0)
    section.comparisons.append(
        compare(
            name, f"{programme.name} (cost and prices only)",
            taken["dvax"], taken["lp"], direction="other/dvax",
        )
    )  # fmt: skip
    if "clarabel" in taken:
        away = float(np.abs(np.array(others) - ours.us).max())
        section.comparisons.append(
            compare(
                name, "Clarabel", taken["dvax"], taken["clarabel"],
                direction="other/dvax", target=("≥", 1.0),
            )
        )  # fmt: skip
        section.notes.append(
            f"Clarabel, {name}: outputs differ from those of dvax by at most {away:.1e} MW."
        )
