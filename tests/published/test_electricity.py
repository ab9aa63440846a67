"""The market on a network: closed forms, linear programmes with angles, and the rate of adaptation."""

import os

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from benchmarks.cases.published_electricity import (
    FOLDER,
    MINUTES,
    gap,
    law,
    linear_programmes,
    solve,
)
from benchmarks.electric_network import (
    LONG,
    PRICE,
    SHORT,
    Network,
    lines_that_may_bind,
    market,
    read_network,
)
from benchmarks.peers.dispatch import LinearProgramme

import dvax

HOURS = 5


def network(seed=0):
    """Four buses in a triangle and a spur of two circuits, four units of which one is wind."""
    rng = np.random.default_rng(seed)
    rows = (HOURS - 1) * 60 // MINUTES + 1
    return Network(
        buses=np.arange(1, 5), unit_bus=np.array([0, 0, 1, 3]),
        cost=np.array([12.0, 0.0, 25.0, 45.0]), slope=np.array([0.05, 1e-3, 0.02, 0.1]),
        is_wind=np.array([False, True, False, False]), load_bus=np.array([1, 2, 3]),
        ends=np.array([[0, 1], [1, 2], [2, 0], [2, 3], [2, 3]]),
        susceptance=np.array([9.0, 5.0, 7.0, 4.0, 3.0]),
        limit=np.array([60.0, 900.0, 45.0, 50.0, 30.0]), dc_ends=(0, 3), dc_limit=10.0,
        capacity=np.tile([150.0, 0.0, 120.0, 100.0], (HOURS, 1)),
        wind=60.0 * rng.random((rows, 1)), load=70.0 + 30.0 * rng.random((HOURS, 3)),
    )  # fmt: skip


def two_buses():
    """A cheap unit behind a line, and a dear one at the load."""
    return Network(
        buses=np.arange(2), unit_bus=np.array([0, 0, 1]), cost=np.array([10.0, 0.0, 30.0]),
        slope=np.array([0.1, 1e-3, 0.2]), is_wind=np.array([False, True, False]),
        load_bus=np.array([1]), ends=np.array([[0, 1]]), susceptance=np.array([5.0]),
        limit=np.array([40.0]), dc_ends=(0, 1), dc_limit=1e-9,
        capacity=np.tile([300.0, 0.0, 300.0], (41, 1)), wind=np.zeros((481, 1)),
        load=np.full((41, 1), 100.0),
    )  # fmt: skip


def at_hours(case, seed=1):
    ts = np.arange(case.first, case.last + 1.0)
    x = np.random.default_rng(seed).normal(size=(len(ts), len(case.network.load_bus)))
    return law(case, ts, 10.0 * x)


def test_prices_and_outputs_on_two_buses_are_those_of_the_closed_form():
    case = market(two_buses(), 0, 40)
    found = law(case, np.zeros(1), np.zeros((1, 1)))
    # p + β(L − D) = 30 + 0.2 (D − 40), with β = p/(ε L).
    beta = PRICE / (SHORT * 100.0)
    demand = (PRICE + beta * 100.0 - 30.0 + 0.2 * 40.0) / (beta + 0.2)
    expected = [40.0, 0.0, demand - 40.0, demand, 0.0]
    np.testing.assert_allclose(found.us[0], expected, atol=1e-6)
    np.testing.assert_allclose(found.prices[0], [14.0, 30.0 + 0.2 * (demand - 40.0)], atol=1e-6)


@pytest.mark.slow
def test_demand_has_the_long_elasticity_in_the_end():
    case = market(two_buses(), 0, 40)
    solution = solve(case, np.array([40.0]), False)
    found = law(case, np.array([40.0]), np.asarray(solution.xs))
    price, demand = found.prices[0, 1], found.us[0, 3]
    expected = 100.0 * (1.0 - LONG * (price / PRICE - 1.0))
    # What is left of the start decays at the rate s ε_s/ε_l or faster.
    assert demand == pytest.approx(expected, abs=10.0 * np.exp(-40.0 * SHORT / LONG))


def test_lines_are_left_out_only_if_no_flow_reaches_their_limit():
    net = network()
    lines = lines_that_may_bind(net)
    flows, most = net.transfer_factors() @ net.injections(), net.largest_capacity()
    balance = np.concatenate([np.ones(4), -np.ones(3), [0.0]])
    bounds = np.stack([np.append(np.zeros(7), -net.dc_limit), most], axis=1)
    largest = [
        max(
            -scipy.optimize.linprog(sign * h, A_eq=balance[None], b_eq=[0.0], bounds=bounds).fun
            for sign in (1.0, -1.0)
        )
        for h in flows
    ]
    can_bind = np.flatnonzero(np.array(largest) > net.limit)
    assert lines.impossible == len(net.limit) - len(can_bind) == 1
    # Circuits 3 and 4 are parallel: 4/50 < 3/30.
    assert lines.row.tolist() == [k for k in can_bind if k != 3] and lines.parallel == 1


@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_cost_lies_within_the_bound_of_the_linear_programme(scale):
    case = market(network(), 0, HOURS - 1, scale)
    hours = at_hours(case)
    assert np.any(hours.multipliers[:, 1:] != 0), "no line binds: the test has no congestion"
    costs, prices, _, _ = linear_programmes(case.network, hours)
    excess = hours.us[:, :4] @ case.network.cost - costs
    bound = gap(case, hours)
    assert np.all(excess >= -1e-6) and np.all(excess <= bound + 1e-6)
    assert prices.shape == hours.prices.shape


def test_dispatch_is_the_linear_programme_of_its_own_marginal_costs():
    net = network()
    case = market(net, 0, HOURS - 1)
    hours = at_hours(case)
    for capacity, u, price in zip(hours.capacity, hours.us, hours.prices, strict=True):
        own = net.cost + net.slope * u[:4]
        least, _ = LinearProgramme(net._replace(cost=own)).solve(capacity, u[4:7])
        assert own @ u[:4] == pytest.approx(least, rel=1e-8)
        # The price of a bus is the marginal cost of each unit there that is at no bound.
        free = (u[:4] > 1e-6) & (u[:4] < capacity - 1e-6)
        np.testing.assert_allclose(price[net.unit_bus][free], own[free], rtol=1e-9)


def test_blocks_of_constant_cost_come_near_with_the_square_of_their_width():
    net = network()
    case = market(net, 0, HOURS - 1)
    hours = at_hours(case)
    g = hours.us[:, :4]
    own = g @ net.cost + 0.5 * g**2 @ net.slope
    for blocks in (5, 20):
        costs, _, _, _ = linear_programmes(net, hours, blocks, net.slope)
        chord = np.sum(net.slope * (hours.capacity / blocks) ** 2, axis=1) / 8
        assert np.all(costs - own >= -1e-6) and np.all(costs - own <= chord + 1e-6)


@pytest.mark.slow
def test_verify_proves_the_constants():
    case = market(network(), 0, HOURS - 1)
    found = dvax.verify(case.problem, jnp.zeros(3), case.first, case.last).constants
    for name in ("gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f", "M", "omega"):
        own, derived = float(getattr(case.constants, name)), float(getattr(found, name))
        assert derived == pytest.approx(own, abs=1e-9), name
    assert float(found.one_sided) == pytest.approx(-SHORT / LONG)


@pytest.mark.slow
def test_error_of_a_run_lies_below_its_bound():
    case = market(network(), 0, HOURS - 1)
    ts = np.arange(case.first, case.last + 1.0)
    solution = solve(case, ts, True)
    assert int(solution.stats["steps"]) == (HOURS - 1) * 60 // MINUTES
    bound = dvax.bound_error(case.problem, solution, case.constants)
    fine = dvax.solve(case.problem, jnp.zeros(3), case.first, case.last, ts=ts, dt=1 / 600).xs
    error = np.sqrt(np.sum(case.beta * np.asarray(solution.xs - fine) ** 2, axis=1))
    assert np.all(error <= np.asarray(bound.x) + 1e-6) and float(bound.x.max()) < 10.0
    assert float(np.max(np.asarray(solution.law_error))) < 1e-9


def write(folder):
    """Write a day of two buses in the format of RTS-GMLC."""
    units = [
        "101_CC_1,101,CC,NG,300,4.0,7000,7200,7500", "102_WIND_1,102,WIND,Wind,150,0,0,0,0",
        "101_WIND_2,101,WIND,Wind,90,0,0,0,0", "102_PV_1,102,PV,Solar,80,0,0,0,0",
    ]  # fmt: skip
    files = {
        "gen.csv": ["GEN UID,Bus ID,Unit Type,Fuel,PMax MW,Fuel Price $/MMBTU,HR_incr_1,HR_incr_2,"
                    "HR_incr_3", *units],
        "bus.csv": ["Bus ID,MW Load,Area", "101,30,1", "102,90,1"],
        "branch.csv": ["From Bus,To Bus,X,Cont Rating,Tr Ratio", "101,102,0.1,50,0",
                       "102,101,0.1,50,1.25"],
        "dc_branch.csv": ["From Bus,To Bus,MW Load", "101,102,20"],
    }  # fmt: skip
    hourly = {
        "DAY_AHEAD_regional_Load": "1", "DAY_AHEAD_wind": "102_WIND_1,101_WIND_2",
        "DAY_AHEAD_pv": "102_PV_1", "DAY_AHEAD_rtpv": "102_RTPV_1", "DAY_AHEAD_hydro": "101_HYDRO_1",
        "REAL_TIME_wind": "101_WIND_2,102_WIND_1",
    }  # fmt: skip
    for name, columns in hourly.items():
        per_day = 288 if name.startswith("REAL") else 24
        numbers = (
            ",".join(str(0.3 * (j + 1) * k) for j in range(columns.count(",") + 1))
            for k in range(1, per_day + 1)
        )
        rows = [f"2020,1,1,{k},{cells}" for k, cells in enumerate(numbers, start=1)]
        files[f"{name}.csv"] = [f"Year,Month,Day,Period,{columns}", *rows]
    for name, rows in files.items():
        (folder / name).write_text("\n".join(rows) + "\n")


def test_reader_splits_the_load_and_orders_the_wind(tmp_path):
    write(tmp_path)
    net = read_network(tmp_path)
    np.testing.assert_allclose(net.load[3], [1.2 * 30 / 120, 1.2 * 90 / 120])
    assert net.unit_bus.tolist() == [0, 1, 0, 1, 0, 1]
    assert net.is_wind.tolist() == [False, True, True, False, False, False]
    np.testing.assert_allclose(net.wind[9], [6.0, 3.0])
    np.testing.assert_allclose(net.susceptance, [10.0, 8.0])
    (tmp_path / "bus.csv").unlink()
    with pytest.raises(FileNotFoundError, match=r"no bus\.csv"):
        read_network(tmp_path)


def test_a_day_of_the_data_lies_within_the_bound():
    folder = os.environ.get(FOLDER, "absent")
    try:
        net = read_network(folder)
    except FileNotFoundError:
        pytest.skip(f"{FOLDER} names no folder with the files of RTS-GMLC")
    assert (len(net.buses), len(net.limit), len(net.wind)) == (73, 120, 105_408)
    case = market(net, 24 * 182, 24 * 183)
    solution = solve(case, np.arange(case.first, case.last + 1.0), False)
    hours = law(case, np.asarray(solution.ts), np.asarray(solution.xs))
    costs, _, _, _ = linear_programmes(net, hours)
    excess = hours.us[:, : net.units] @ net.cost - costs
    assert np.all(excess >= -1e-7 * costs) and np.all(excess <= gap(case, hours) + 1e-7 * costs)
