"""American puts of the literature as obstacle problems, with bounds on each error."""

import importlib
import resource
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from ..american_put import (
    Enclosure,
    Grid,
    Put,
    at_price,
    boundary,
    enclose,
    solve,
    values,
)  # fmt: skip
from ..clock import in_turn, timed
from ..layout import duration
from ..peers.american import IntegralEquation, finite_differences, tree
from ..section import Comparison, Section, Table, Target, compare

_WIDTH, _TOL = 3e-5, 3e-7
"""ε in years and the tolerance of the enclosed values; a tenth of both with --full."""
_FAST_WIDTH, _FAST_TOL = 5e-4, 1e-3
"""The same for the race at equal error."""
_TREE_STEPS = 16_000
_RESOLUTION = 80
"""Cells in σ√T of the finest grid; values are extrapolated from this one and one of half."""


class Published(NamedTuple):
    """A table of the literature, for the strike 100."""

    source: str
    put: Put
    rows: tuple[tuple[float, float], ...]


TABLES = (
    Published(
        "Mathematics 8(9), 1563 (binomial)",
        Put(0.05, 0.0, 0.2),
        ((90.0, 11.4928), (100.0, 6.0903), (110.0, 2.9866), (120.0, 1.3672)),
    ),
    Published(
        "HODIE scheme (true values)",
        Put(0.04, 0.02, 0.3),
        (
            (75.9572, 25.32986), (83.9457, 19.49691), (92.7743, 14.26265), (102.5315, 9.84354),
            (113.3148, 6.36558), (125.2323, 3.83337), (138.4031, 2.13784),
        ),
    ),
)  # fmt: skip
BOUNDARY = Put(0.1, 0.0, 0.2)
BOUNDARIES = (
    ("Nielsen et al. 2002", 0.8622),
    ("Company et al. 2014", 0.8628),
    ("Fazio et al. 2019", 0.86274),
    ("Clevenhaus et al. 2020", 0.86269),
)


def run(full: bool) -> Section:
    width, tol = (0.1 * _WIDTH, 0.1 * _TOL) if full else (_WIDTH, _TOL)
    section = Section(
        title="american_options: published values of American puts",
        fair=(
            "Prices are for the strike 100 and one year. dvax: the mean of the two penalty laws of "
            f"width ε = {width:g} years at the tolerance {tol:g}, extrapolated from grids of "
            f"{_RESOLUTION // 2} and {_RESOLUTION} cells in one standard deviation of ln S. The errors "
            "of penalty and time integration are proved for the equations on the grid; that of the "
            "grid is estimated by the difference from the extrapolation of the next coarser pair. The "
            "reference is an integral equation of the exercise boundary "
            "(`benchmarks/peers/american.py`), which shares no code with dvax; the tree has "
            f"{_TREE_STEPS} steps. The race: dvax with "
            f"ε = {_FAST_WIDTH:g} years at the tolerance {_FAST_TOL:g}, as called, four runs, no "
            "certificate; the tree and the finite differences with the fewest steps that achieve the "
            "error of dvax at all prices; the tree runs once for each price. QuantLib, where it is "
            "installed, solves an integral equation for each price (its accurate scheme)."
        ),
    )
    costs = Table(
        "Cost of the values: two laws on two grids, with their certificates",
        ("values", "cells", "steps", "time"),
        [],
    )
    for table in TABLES:
        _values(section, costs, table, width, tol)
    _boundary(section)
    _greeks(section)
    _certificate(section)
    for table in TABLES:
        _race(section, table, 7 if full else 3)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    costs.rows.append(("all of this case: peak memory", "", "", f"{peak / 1e9:.2f} GB"))
    section.tables.append(costs)
    return section


def _pair(coarse: Any, fine: Any) -> Any:
    """Extrapolate from a grid and one of half the width, on which the error is a quarter."""
    return (4.0 * np.asarray(fine) - np.asarray(coarse)) / 3.0


def _reference(put: Put) -> IntegralEquation:
    return IntegralEquation(put.rate, put.dividend, put.volatility, put.expiry)


def _values(section: Section, costs: Table, table: Published, width: float, tol: float) -> None:
    put, rows = table.put, table.rows
    prices = np.array([row[0] for row in rows]) / 100.0
    began = time.perf_counter()
    coarse, fine = (
        enclose(Grid.of(put, cells), put, width, tol, prices)
        for cells in (_RESOLUTION // 2, _RESOLUTION)
    )
    seconds = time.perf_counter() - began
    coarsest = _middle(put, _RESOLUTION // 4, width, tol, prices)
    found = 100 * _pair(coarse.values, fine.values)
    mesh = np.abs(found - 100 * _pair(coarsest, coarse.values))
    penalty, steps = (
        100 * (4 * getattr(fine, name) + getattr(coarse, name)) / 3 for name in ("penalty", "time")
    )
    oracle = _reference(put)
    exact = np.array([100 * oracle.value(p) for p in prices])
    trees = np.array([100 * tree(p, *put, _TREE_STEPS) for p in prices])
    bound = penalty + steps + mesh
    status = _weakest(coarse, fine)
    section.tables.append(
        Table(
            f"{table.source}: r = {put.rate:g}, d = {put.dividend:g}, σ = {put.volatility:g}",
            ("S", "published", "dvax", f"penalty ({status})", f"time ({status})",
             "grid (estimated)", "integral equation", "tree", "published − reference",
             "dvax − reference"),
            [
                (str(S), str(told), f"{v:.5f}", f"{p:.1e}", f"{t:.1e}", f"{m:.1e}", f"{e:.5f}",
                 f"{b:.5f}", f"{told - e:+.1e}", f"{v - e:+.1e}")
                for (S, told), v, p, t, m, e, b in zip(
                    rows, found, penalty, steps, mesh, exact, trees
                )
            ],
        )
    )  # fmt: skip
    section.comparisons.append(
        Comparison(
            f"{table.source}: dvax − reference, over its bound", "", None, None,
            error=float(np.max(np.abs(found - exact))),
            target=Target("≤", 1.0, float(np.max(np.abs(found - exact) / bound))),
        )
    )  # fmt: skip
    cells = [str(Grid.of(put, k).cells) for k in (_RESOLUTION // 2, _RESOLUTION)]
    costs.rows.append(
        (table.source, " and ".join(cells), str(coarse.steps + fine.steps), duration(seconds))
    )


def _weakest(*enclosures: Enclosure) -> str:
    found = {e.status for e in enclosures}
    return found.pop() if len(found) == 1 else "not all proved"


def _middle(put: Put, cells: int, width: float, tol: float, prices: np.ndarray) -> np.ndarray:
    """Return the mean of the two penalty laws at the prices, without a certificate."""
    grid = Grid.of(put, cells)
    on_grid = [values(grid, put, solve(grid, put, width, q, tol).xs[-1]) for q in (False, True)]
    mean = 0.5 * (on_grid[0] + on_grid[1])
    return np.array([float(at_price(grid, mean, p)) for p in prices])


def _boundary(section: Section) -> None:
    put, found = BOUNDARY, []
    for cells in (_RESOLUTION, 2 * _RESOLUTION):
        grid = Grid.of(put, cells)
        runs = [solve(grid, put, 1e-4, above, 1e-4) for above in (False, True)]
        on_grid = [values(grid, put, sol.xs[-1]) for sol in runs]
        found.append(boundary(grid, put, 0.5 * (on_grid[0] + on_grid[1])))
    exact = float(_reference(put).boundary(put.expiry))
    estimate = abs(found[1] - found[0])
    section.tables.append(
        Table(
            "The exercise boundary one year before expiry: K = 1, r = 0.1, d = 0, σ = 0.2",
            ("source", "published", "dvax", "error (estimated)", "integral equation",
             "published − reference", "dvax − reference"),
            [
                (name, f"{told:g}", f"{found[1]:.5f}", f"{estimate:.0e}", f"{exact:.5f}",
                 f"{told - exact:+.1e}", f"{found[1] - exact:+.1e}")
                for name, told in BOUNDARIES
            ],
        )
    )  # fmt: skip


def _price(grid: Grid, S: Any, rate: Any, volatility: Any) -> jax.Array:
    """Return the mean value of the two laws at S, which JAX differentiates forward."""
    put = Put(rate, 0.0, volatility)
    runs = [
        solve(grid, put, _FAST_WIDTH, q, _FAST_TOL, adjoint="forward").xs[-1] for q in (False, True)
    ]
    return at_price(grid, values(grid, put, 0.5 * (runs[0] + runs[1])), S)


def _greeks(section: Section) -> None:
    put = TABLES[0].put
    grids = [Grid.of(put, cells) for cells in (_RESOLUTION // 2, _RESOLUTION)]
    prices = (0.9, 1.0, 1.1, 1.2)

    def tangents(grid: Grid) -> list[np.ndarray]:
        derivatives = jax.jit(jax.jacfwd(partial(_price, grid), argnums=(0, 1, 2)))
        at = (put.rate, put.volatility)
        return [np.array(derivatives(S, *at))[[0, 2, 1]] for S in prices]

    found = [_pair(a, b) for a, b in zip(*map(tangents, grids))]
    percent = np.array([1.0, 100.0, 100.0])
    rows = []
    for S, ours in zip(prices, found):
        pairs = zip(percent * ours, percent * _differences(put, S))
        rows.append((f"{100 * S:g}", *(f"{v:.4f} ({w:.4f})" for v, w in pairs)))
    section.tables.append(
        Table(
            "Derivatives by jax.jacfwd, in brackets by differences of the integral equation: "
            "r = 0.05, d = 0, σ = 0.2",
            ("S", "delta", "vega", "rho"),
            rows,
        )
    )


def _differences(put: Put, S: float, h: float = 1e-3) -> np.ndarray:
    """Return delta, vega and rho by central differences of the integral equation."""

    def value(rate: float, volatility: float, S: float) -> float:
        return IntegralEquation(rate, put.dividend, volatility, put.expiry).value(S)

    r, sigma = put.rate, put.volatility
    pairs = (
        (value(r, sigma, S + h), value(r, sigma, S - h)),
        (value(r, sigma + h, S), value(r, sigma - h, S)),
        (value(r + h, sigma, S), value(r - h, sigma, S)),
    )
    return np.array([(up - down) / (2 * h) for up, down in pairs])


def _certificate(section: Section) -> None:
    """Compare the bound of the time integration with the error against a run at a tighter tolerance."""
    put, at, tol = TABLES[0].put, 1.0, 1e-4
    grid = Grid.of(put, _RESOLUTION // 4)
    for width in (1e-2, 1e-3):
        bound = float(enclose(grid, put, width, tol, [at]).time[0])
        errors = []
        for above in (False, True):
            runs = [solve(grid, put, width, above, t) for t in (tol, 1e-3 * tol)]
            ends = [float(at_price(grid, values(grid, put, sol.xs[-1]), at)) for sol in runs]
            errors.append(abs(ends[0] - ends[1]))
        section.comparisons.append(
            Comparison(
                f"bound of the time integration over its error, ε = {width:g}, S = 100",
                f"dvax at the tolerance {1e-3 * tol:g}", None, None, error=100 * max(errors),
                error_other=100 * bound, target=Target("≤", 100.0, bound / max(errors), "×"),
            )
        )  # fmt: skip


def _race(section: Section, table: Published, rounds: int) -> None:
    put = table.put
    prices = np.array([row[0] for row in table.rows]) / 100.0
    data = (put.rate, put.dividend, put.volatility, put.expiry)
    oracle = _reference(put)
    exact = np.array([oracle.value(p) for p in prices])
    grids = [Grid.of(put, cells) for cells in (_RESOLUTION // 2, _RESOLUTION)]

    def ours() -> np.ndarray:
        ends = []
        for grid in grids:
            runs = [solve(grid, put, _FAST_WIDTH, q, _FAST_TOL).xs[-1] for q in (False, True)]
            mean = values(grid, put, 0.5 * (runs[0] + runs[1]))
            ends.append([float(at_price(grid, mean, p)) for p in prices])
        return _pair(*ends)

    def error(found: Any) -> float:
        return float(np.max(np.abs(np.asarray(found) - exact)))

    reached = error(ours())
    peers: dict[str, Callable[[], Any]] = {}
    for name, runs in (
        ("binomial tree (BBSR), {} steps",
         {n: lambda n=n: [tree(p, *data, n) for p in prices] for n in [500 * 2**k for k in range(8)]}),
        ("Crank–Nicolson, {} cells in σ√T",
         {n: lambda n=n: _extrapolated(data, n, prices) for n in [25 * 2**k for k in range(7)]}),
    ):  # fmt: skip
        steps = next((n for n, fn in runs.items() if error(fn()) <= reached), list(runs)[-1])
        peers[name.format(steps)] = runs[steps]
    quantlib = _quantlib(put, prices)
    if quantlib is None:
        section.notes.append("QuantLib is not installed (pip install QuantLib).")
    else:
        peers["QuantLib, QdFp (accurate)"] = quantlib
    taken = in_turn({"dvax": timed(ours)} | {name: timed(fn) for name, fn in peers.items()}, rounds)
    for name, fn in peers.items():
        section.comparisons.append(
            compare(
                f"{table.source}: {len(prices)} values at equal error", name, taken["dvax"],
                taken[name], direction="other/dvax", error=100 * reached,
                error_other=100 * error(fn()),
            )
        )  # fmt: skip


def _extrapolated(data: tuple[Any, ...], cells: int, prices: np.ndarray) -> np.ndarray:
    """Return the values of finite differences, extrapolated as those of dvax."""
    coarse, fine = (
        finite_differences(*data, cells=n, steps=2 * n)(prices) for n in (cells // 2, cells)
    )
    return _pair(coarse, fine)


def _quantlib(put: Put, prices: np.ndarray) -> Callable[[], Any] | None:
    """Return a function of the values by QuantLib, or None if it is not installed."""
    try:
        ql = importlib.import_module("QuantLib")
    except ImportError:
        return None
    today = ql.Date(1, 1, 2021)
    ql.Settings.instance().evaluationDate = today
    count = ql.Actual365Fixed()

    def flat(rate: float) -> Any:
        return ql.YieldTermStructureHandle(ql.FlatForward(today, rate, count))

    volatility = ql.BlackConstantVol(today, ql.NullCalendar(), put.volatility, count)
    spot = ql.SimpleQuote(1.0)
    process = ql.BlackScholesMertonProcess(
        ql.QuoteHandle(spot),
        flat(put.dividend),
        flat(put.rate),
        ql.BlackVolTermStructureHandle(volatility),
    )
    option = ql.VanillaOption(
        ql.PlainVanillaPayoff(ql.Option.Put, 1.0), ql.AmericanExercise(today, today + 365)
    )
    engine = ql.QdFpAmericanEngine
    option.setPricingEngine(engine(process, engine.accurateScheme()))

    def evaluate() -> list[float]:
        found = []
        for p in prices:
            spot.setValue(p)
            found.append(option.NPV())
        return found

    return evaluate
