"""Published circuits: the numbers of the Siconos tutorials are those of their scheme, and dvax agrees
with exact solutions that share no code with it."""

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks import buck_converter, switching
from benchmarks.cases.published_circuits import PUBLISHED
from tests.selection import mostly_thorough

import dvax
from dvax.models.circuit import Circuit

FOLDER = os.environ.get("DVAX_SICONOS", "")
CAPACITY, INDUCTANCE, LOAD, FILTER = 1e-6, 1e-2, 1e3, 3e-7


def theta_scheme(A, theta, h, steps, x0, implicit):
    """x after each step of (1 − hθA) y = (1 + h(1 − θ)A) x + …, where `implicit` adds the currents of
    the diodes at the end of the step: it maps the right-hand side to y."""
    eye, x, rows = np.eye(len(x0)), np.array(x0), []
    for _ in range(steps):
        x = implicit((eye + h * (1.0 - theta) * A) @ x)
        rows.append(x)
    return np.array(rows)


def tutorial_scheme(name, h, steps):
    """The scheme of a tutorial, with its complementarity problem solved by cases."""
    A = np.array([[0.0, -1.0 / CAPACITY], [1.0 / INDUCTANCE, 0.0]])
    if name == "DiodeBridgeCapFilter":
        A = np.block([[A, np.zeros((2, 1))], [np.zeros((1, 2)), -1.0 / (LOAD * FILTER)]])
    theta, n = PUBLISHED[name].theta, len(A)
    free = np.linalg.inv(np.eye(n) - h * theta * A)
    loaded = np.eye(n) - h * theta * A
    loaded[0, 0] += h / (LOAD * CAPACITY)
    loaded = np.linalg.inv(loaded)

    def tank(right):
        return loaded @ right if (free @ right)[0] > 0.0 else free @ right

    def bridge(right):
        return loaded @ right  # the load sees |v|

    def filtered(right):
        y = free @ right
        if abs(y[0]) <= y[2]:
            return y
        # v = s w: a current i leaves C1 and enters C2, with y − s w + (response) i = 0.
        s = np.sign(y[0])
        response = free @ np.array([-s / CAPACITY, 0.0, 1.0 / FILTER]) * h
        i = (y[2] - s * y[0]) / (s * response[0] - response[2])
        return y + response * i

    cases = {"CircuitRLCD": tank, "DiodeBridge": bridge, "DiodeBridgeCapFilter": filtered}
    return theta_scheme(A, theta, h, steps, [10.0] + [0.0] * (n - 1), cases[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_numbers_are_those_of_a_first_order_scheme(name):
    given = PUBLISHED[name]
    steps = len(given.times) - 1
    coarse = tutorial_scheme(name, given.step, steps)
    assert np.abs(coarse[-1, :2] - given.last[1:]).max() <= 2e-12
    fine = tutorial_scheme(name, given.step / 4, 4 * steps)[3::4]
    exact = given.exact(given.times)[1:]
    late = given.times[1:] >= 1e-5
    errors = [np.abs(x - exact[:, : x.shape[1]])[late, 0].max() for x in (coarse, fine)]
    assert errors[0] > 1e-2, "the published error is no rounding"
    assert 3.0 <= errors[0] / errors[1] <= 8.0, errors


@pytest.mark.skipif(
    not FOLDER, reason="DVAX_SICONOS names no folder with the files of the tutorials"
)
@pytest.mark.parametrize("name", PUBLISHED)
def test_files_are_those_of_the_scheme_of_the_tutorials(name):
    given = PUBLISHED[name]
    rows = np.loadtxt(Path(FOLDER) / given.file, skiprows=1)
    assert np.abs(rows[-1, :3] - given.last).max() <= 1e-14
    own = tutorial_scheme(name, given.step, len(rows) - 1)
    assert np.abs(rows[1:, 1:3] - own[:, :2]).max() <= 5e-12


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(PUBLISHED, ["DiodeBridge"]))
def test_dvax_is_within_its_bound_of_the_exact_circuit(name):
    given = PUBLISHED[name]
    circuit, ts = Circuit(given.netlist, **given.options), given.times[::50]
    sol = circuit.solve(ts[-1], ts=ts)
    off = np.asarray(sol.xs) - given.own(ts)
    bound = dvax.bound_error(circuit.problem, sol, circuit.constants)
    energy = np.sqrt(np.sum(np.asarray(circuit.storage) * off**2, axis=1))
    # Two roundings beside the bound: the exact solution is returned in double precision, and the
    # entries of its matrices, rates up to 2·10⁹ per second, and of their exponentials are rounded to
    # long double.
    fastest = max(float(np.abs(mode.Z).max()) for mode in given.regularised.values())
    relative = np.finfo(float).eps + 4.0 * float(np.finfo(np.longdouble).eps) * fastest * ts
    rounding = relative * np.sqrt(CAPACITY) * 10.0
    assert np.all(energy <= np.asarray(bound.x) + rounding)
    assert np.abs(off[:, 0]).max() <= 5e-9
    distance = np.abs(given.exact(ts) - np.asarray(sol.xs))[ts >= 1e-5, 0].max()
    assert distance <= 3e-5  # of ideal diodes


def test_resistance_of_diodes_moves_the_filtered_bridge_in_proportion():
    ts = PUBLISHED["DiodeBridgeCapFilter"].times[20::100]
    ideal = PUBLISHED["DiodeBridgeCapFilter"].exact(ts)
    distance = [
        np.abs(
            switching.follow(
                switching.filtered(r, 1e-6 * r), np.array([10.0, 0.0, 0.0]), [(0.0, np.zeros(0))], ts
            )[0] - ideal
        )[:, 0].max()
        for r in (1e-3, 5e-4)
    ]  # fmt: skip
    assert distance[0] / distance[1] == pytest.approx(2.0, rel=0.02)


def test_bridge_with_a_leak_of_r_over_load_squared_has_the_resistance_of_its_load():
    # A lattice whose arms are r and z with r z = R² has the input resistance R when loaded with R; z is
    # 1/g + r, so that what is left is of the order (r/R)².
    ts, start = PUBLISHED["DiodeBridge"].times[::100], np.array([10.0, 0.0])
    off = {
        g: np.abs(
            switching.follow(switching.bridge(0.1, g), start, [(0.0, np.zeros(0))], ts)[0]
            - switching.ideal_bridge(ts)
        )[:, 0].max()
        for g in (1e-7, 1e-9)
    }
    assert off[1e-9] > 5e-4
    assert off[1e-7] < 1e-11


def solve_buck(end, ts, leak=1e-6):
    return dvax.solve(
        buck_converter.problem(leak, end), jnp.zeros(5), 0.0, end, ts=ts,
        method=dvax.PiecewiseLinear(), rtol=1e-8, atol=1e-9, max_steps=100_000,
    )  # fmt: skip


@pytest.mark.parametrize("end", mostly_thorough([1e-6, 2e-6, 2e-5], [1e-6]))
def test_buck_converter_with_feedback_agrees_with_matrix_exponentials(end):
    ts = np.linspace(0.0, end, 41)
    exact, switchings = buck_converter.exact(1e-6, ts)
    sol = solve_buck(end, ts)
    assert int(sol.stats["switchings"]) == switchings
    assert np.abs(np.asarray(sol.xs) - exact).max() <= 1e-9


@pytest.mark.parametrize("periods", mostly_thorough([8, 1000], [8]))
def test_converter_agrees_with_matrix_exponentials(periods):
    ts = 1e-5 * np.arange(1, periods + 1)
    exact, _ = switching.follow(
        switching.converter(), np.zeros(2), switching.pulses(periods), ts, fewest=50
    )
    circuit = Circuit(switching.CONVERTER)
    sol = circuit.solve(ts[-1], ts=ts, max_steps=100_000)
    off = np.asarray(sol.xs) - exact
    bound = dvax.bound_error(circuit.problem, sol, circuit.constants)
    energy = np.sqrt(np.sum(np.asarray(circuit.storage) * off**2, axis=1))
    assert np.all(energy <= np.asarray(bound.x) + 1e-15)
    assert np.abs(off[:, 0]).max() <= 1e-9
