"""Every week of the RTS-GMLC year is solved at the default tolerances, for any origin of time."""

import os
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax.formats import read_rts
from dvax.models.market import Market

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "RTS-GMLC"
pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason=f"RTS-GMLC is not in {FOLDER}, and its licence forbids copying it"
)
WIND = Path(os.environ.get("DVAX_RTS", "")) / "REAL_TIME_wind.csv"
WEEKS = [4000, 8616, *range(0, 8736, 168)]


@pytest.fixture(scope="module")
def data():
    return read_rts(FOLDER)


@pytest.mark.parametrize("start", mostly_thorough(WEEKS, []))
def test_market_weeks_succeed_at_the_default_tolerances(data, start):
    market = Market.from_rts(data, start, min(168, len(data.load) - start))
    sol = market.run()
    assert float(sol.ts[-1]) == float(market.intercept.span()[1])
    bound = dvax.bound_error(market.problem, sol, market.constants)
    assert float(bound.x.max()) < 1e-4


@pytest.mark.thorough
def test_market_whole_year_succeeds_in_one_run(data):
    sol = Market.from_rts(data, 0, len(data.load)).run()
    assert np.isfinite(np.asarray(sol.xs)).all() and sol.ts.shape == (len(data.load),)


@pytest.mark.thorough
@pytest.mark.parametrize("start", [0, 4000, 8500])
def test_market_with_wind_data_every_five_minutes(data, start):
    market = Market.from_rts(data, start, 168)
    rng, times = np.random.default_rng(start), start + np.arange(167 * 12 + 1) / 12.0
    hourly = np.asarray(market.capacity.values)
    finer = np.stack([np.interp(times, market.capacity.times, row) for row in hourly.T], axis=1)
    moves = np.ptp(finer, axis=0) > 0
    noise = 1.0 + 0.05 * rng.standard_normal((len(times), int(moves.sum())))
    finer[:, moves] = np.maximum(0.0, finer[:, moves] * noise)
    windy = eqx.tree_at(lambda m: m.capacity, market, dvax.signals.Table(times, finer))
    assert float(windy.run().ts[-1]) == start + 167.0


@pytest.mark.thorough
@pytest.mark.skipif(not WIND.is_file(), reason="DVAX_RTS names no folder with REAL_TIME_wind.csv")
@pytest.mark.parametrize("start", WEEKS)
def test_market_with_measured_wind_every_five_minutes(data, start):
    hours = min(168, len(data.load) - start)
    market = Market.from_rts(data, start, hours)
    names = WIND.read_text().partition("\n")[0].split(",")[4:]
    wind = np.loadtxt(WIND, delimiter=",", skiprows=1)[:, 4:]
    times = start + np.arange((hours - 1) * 12 + 1) / 12.0
    hourly = np.asarray(market.capacity.values)
    finer = np.stack([np.interp(times, market.capacity.times, row) for row in hourly.T], axis=1)
    for name, power in zip(names, wind.T, strict=True):
        finer[:, data.names.index(name)] = power[start * 12 : start * 12 + len(times)]
    windy = eqx.tree_at(lambda m: m.capacity, market, dvax.signals.Table(times, finer))
    sol = windy.run()
    assert float(sol.ts[-1]) == start + hours - 1.0
    assert float(dvax.bound_error(windy.problem, sol, windy.constants).x.max()) < 1e-6
