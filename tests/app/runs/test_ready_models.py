"""Predictive control, the thermostat and viscoplasticity from configurations: wrong input, results
against independent solutions, resumed runs, and parameters over plausible ranges."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import lsq_linear
from tests.app.runs.test_partial import Stops
from tests.app.runs.test_resume import go_on, results

import dvax
from dvax.app.plots import build_report
from dvax.app.runs.applications.config import read_config
from dvax.app.runs.applications.segments import join_pieces, segments
from dvax.app.runs.driver import run

EXAMPLES = Path(__file__).parents[3] / "examples" / "configurations"
OUTPUT = "[output]\npng = false\nreport = false\ncheckpoint_seconds = 0\n"

PLANT = """[model]
name = "mpc"
A = [[0.0, 1.0], [-1.0, -0.4]]
B = [[0.0], [1.0]]
states = { place = "m", speed = "m/s" }
inputs = { force = "N" }
initial = [1.0, 0.0]
lower = -0.3
upper = 0.3
R = [0.1]
horizon = 3
frames = 20
t_end = 6.0
"""
ROOM = """[model]
name = "thermostat"
cells = [1, 1]
outdoor = "weather.csv"
set_point = "schedule.csv"
frames = 24
t_end = 24.0
"""
STEEL = '[model]\nname = "viscoplasticity"\nstrain = "path.csv"\nframes = 20\n'
FILES = {
    "weather.csv": "time [h], outdoor [degC]\n0, -5\n12, 8\n24, 2\n",
    "schedule.csv": "time [min], set_point [degC]\n0, 17\n390, 21\n1320, 16\n1440, 16\n",
    "path.csv": "time [s], e11 [%], e22 [%], e33 [%]\n0, 0, 0, 0\n1, 0.4, -0.2, -0.2\n"
    "2, 0.4, -0.2, -0.2\n",
    "reference.csv": "time [s], place [cm], speed [m/s]\n0, 20, 0\n3, -10, 0\n6, -10, 0\n",
    "matrix.csv": "0, 1\n-1, x\n",
}
MODELS = {"mpc": PLANT, "thermostat": ROOM, "viscoplasticity": STEEL}


def write(folder: Path, text: str, **files: str) -> Path:
    for name, content in FILES.items():
        (folder / name).write_text(content)
    for name, content in files.items():
        (folder / f"{name}.csv").write_text(content)
    config = folder / "a.toml"
    config.write_text(text)
    return config


def model_of(folder: Path, text: str, **files: str):
    config = read_config(write(folder, text, **files))
    return config.model


# name: (configuration, changed files, what the errors say)
REFUSED = {
    "rows of two lengths": (
        PLANT.replace("[0.0, 1.0]", "[0.0]"),
        {},
        ("a.toml: model.A", "rows of one length"),
    ),
    "not square": (PLANT.replace(", [-1.0, -0.4]", ""), {}, ("a.toml: model.A", "it is square")),
    "no matrix": (
        PLANT.replace("[[0.0], [1.0]]", "3.0"),
        {},
        ("a.toml: model.B", "rows of finite numbers"),
    ),
    "text in a matrix": (
        PLANT.replace("[[0.0, 1.0], [-1.0, -0.4]]", '"matrix.csv"'),
        {},
        ("matrix.csv, line 2, column 2", "'x'"),
    ),
    "limits that cross": (
        PLANT.replace("upper = 0.3", "upper = -0.4"),
        {},
        ("model.lower", "lower < upper"),
    ),
    "a state too many": (
        PLANT.replace("[1.0, 0.0]\nl", "[1.0]\nl"),
        {},
        ("model.initial", "each of the 2 states"),
    ),
    "a name too few": (
        PLANT.replace(', speed = "m/s"', ""),
        {},
        ("model.states", "each of the 2 states"),
    ),
    "no such state": (
        PLANT + 'reference = "reference.csv"\n',
        {"reference": "time [s], plaec [m]\n0, 0\n6, 0\n"},
        ("reference.csv", "Did you mean 'place'?"),
    ),
    "a state without reference": (
        PLANT + 'reference = "reference.csv"\n',
        {"reference": "time [s], place [m]\n0, 0\n6, 0\n"},
        ("reference.csv", "no column speed"),
    ),
    "reference in another unit": (
        PLANT + 'reference = "reference.csv"\n',
        {"reference": "time [s], place [N], speed [m/s]\n0, 0, 0\n6, 0, 0\n"},
        ("reference.csv, column 'place'", "[N]", "converts to m"),
    ),
    "a short reference": (
        PLANT + 'reference = "reference.csv"\n',
        {"reference": "time [s], place [m], speed [m/s]\n0, 0, 0\n5, 0, 0\n"},
        ("reference.csv", "from 0 to 6 s: nothing is extrapolated"),
    ),
    "horizon": (PLANT.replace("horizon = 3", "horizon = 0"), {}, ("model.horizon", "at least 1")),
    "weather in kelvin per hour": (
        ROOM,
        {"weather": "time [h], outdoor [K/h]\n0, 1\n24, 1\n"},
        ("weather.csv, column 'outdoor'", "degC"),
    ),
    "weather without times": (
        ROOM,
        {"weather": "outdoor [degC]\n0\n1\n"},
        ("weather.csv", "'time'"),
    ),
    "no such weather": (
        ROOM.replace("weather.csv", "sun.csv"),
        {},
        ("model.outdoor", "no such file"),
    ),
    "a list": (
        ROOM.replace('"weather.csv"', "[1.0]"),
        {},
        ("model.outdoor", "the name of a CSV file"),
    ),
    "a wrong unit": (ROOM.replace('"weather.csv"', '"3 m"'), {}, ("model.outdoor", "degC")),
    "colder than can be": (ROOM + "initial = -300.0\n", {}, ("model.initial", "at least -273.15")),
    "another unit of temperature": (
        ROOM + 'initial = "288 K"\n',
        {},
        ("model.initial", "does not start at zero", '2.5 degC"'),
    ),
    "ends exchanged": (
        ROOM + "[[model.heaters]]\nx = [1.5, 0.0]\ny = [0.0, 6.0]\n",
        {},
        ("model.heaters[1].x", "the first end is the smaller one"),
    ),
    "less than nothing": (ROOM + "power_max = -1.0\n", {}, ("model.power_min, model.power_max",)),
    "a heater outside": (
        ROOM + "[[model.heaters]]\nx = [9.0, 10.0]\ny = [0.0, 6.0]\n",
        {},
        ("model.heaters[1]", "midpoint of a cell"),
    ),
    "a side of a heater": (
        ROOM + "[[model.heaters]]\nx = [0.0, 8.0]\n",
        {},
        ("model.heaters[1].y", "it is required"),
    ),
    "loss below zero": (ROOM + 'loss = "-1 W/(m^2 K)"\n', {}, ("model.loss", "at least 0")),
    "cells": (ROOM.replace("[1, 1]", "[0, 1]"), {}, ("model.cells",)),
    "a column that is no strain": (
        STEEL,
        {"path": "time [s], e21 [1]\n0, 0\n1, 0\n"},
        ("path.csv", "Did you mean"),
    ),
    "times that repeat": (
        STEEL,
        {"path": "time [s], e11 [1]\n0, 0\n0, 0\n"},
        ("path.csv, line 3", "increase strictly"),
    ),
    "friction of a cylinder": (
        STEEL + "friction = 0.5\n",
        {},
        ("model.friction", "drucker-prager"),
    ),
    "strength of a cone": (
        STEEL + 'yield_condition = "drucker-prager"\nstrength = "2 MPa"\n',
        {},
        ("model.strength", "von-mises"),
    ),
    "stress in metres": (
        STEEL + 'bulk_modulus = "3 m"\n',
        {},
        ("model.bulk_modulus", 'Write "2.5 MPa"'),
    ),
    "a long run": (STEEL + "t_end = 3.0\n", {}, ("path.csv", "from 0 to 3 s")),
}


@pytest.mark.parametrize("name", REFUSED)
def test_wrong_input_of_a_ready_model_is_named_with_its_place(name, tmp_path):
    text, files, words = REFUSED[name]
    with pytest.raises(dvax.InputError) as caught:
        read_config(write(tmp_path, text, **files))
    told = " ".join(str(problem) for problem in caught.value.problems)
    assert all(word in told for word in words), told
    assert "dvax.models" not in told


def test_quantities_and_files_are_converted_to_the_units_of_a_model(tmp_path):
    model = model_of(tmp_path, STEEL.replace("frames", 'bulk_modulus = "160 GPa"\nframes'))
    assert model.table.bulk_modulus == 160e3
    room = model_of(
        tmp_path, ROOM.replace("t_end = 24.0", 't_end = "1 d"\ncapacity = "180 kJ/(m^2 K)"')
    )
    assert room.table.t_end == 24.0 and room.table.capacity == pytest.approx(50.0)
    assert [float(room.set_point(t)) for t in (6.4, 6.6, 22.1)] == [17.0, 21.0, 16.0]
    plant = model_of(tmp_path, PLANT + 'reference = "reference.csv"\n')
    np.testing.assert_allclose(plant.reference.values[:, 0], [0.2, -0.1, -0.1], rtol=1e-14)
    np.testing.assert_allclose(plant.feed.values[:, 0], [0.2, -0.1, -0.1], rtol=1e-12)


@pytest.mark.thorough
def test_a_reference_that_no_input_holds_is_noted(tmp_path):
    (moving,) = model_of(tmp_path, PLANT + "reference = [0.2, 1.0]\n").notes()[:1]
    assert "no input holds it" in moving
    (beyond,) = model_of(tmp_path, PLANT + "reference = [0.5, 0.0]\n").notes()[:1]
    assert "beyond model.lower or model.upper" in beyond


@pytest.mark.parametrize("name", sorted(file.name for file in EXAMPLES.glob("*.toml")))
def test_configurations_of_the_examples_are_correct(name):
    config = read_config(EXAMPLES / name)
    assert config.data_files()


def solved(folder: Path, text: str, **files: str):
    """The outcome of a run with its report, and its trajectory."""
    outcome = run(read_config(write(folder, text + OUTPUT, **files)), folder / "run")
    assert outcome.exit_code == 0
    with xarray.open_zarr(outcome.directory / "trajectory.zarr", consolidated=False) as data:
        return outcome, data.load()


@pytest.mark.thorough
def test_a_room_follows_the_heat_balance_of_scipy(tmp_path):
    outcome, data = solved(tmp_path, ROOM)
    outdoor = lambda t: np.interp(t, [0, 12, 24], [-5, 8, 2])  # noqa: E731

    def rate(t, T, wanted):
        return (2.5 * (outdoor(t) - T) + np.clip(80 * (wanted - T), 0, 80)) / 50

    T, ends, last = [15.0], [0.0, 6.5, 12.0, 22.0, 24.0], np.array([15.0])
    for a, b, wanted in zip(ends[:-1], ends[1:], (17, 21, 21, 16), strict=True):
        ts = np.unique([*(t for t in data.time.values if a < t <= b), b])
        part = solve_ivp(rate, (a, b), last, "DOP853", ts, args=(wanted,), rtol=1e-11, atol=1e-11)
        last = part.y[:, -1]
        T += [y for t, y in zip(part.t, part.y[0], strict=True) if t in data.time.values]
    apart = np.abs(data.mean_temperature.values - T)
    # ‖T‖² = ∫T² over 48 m².
    assert np.all(apart <= data.error_bound.values / np.sqrt(48.0) + 1e-8) and apart.max() < 1e-3
    assert data.error_bound.attrs["status"] == "proved"
    final = outcome.summary["final_mean_temperature"]
    assert abs(final["value"] - T[-1]) <= final["error"] + 1e-8
    power = np.clip(80 * (data.set_point.values - T), 0, 80) * 48 / 1e3
    np.testing.assert_allclose(data.heating_power, power, atol=5e-3)
    page = build_report(outcome.directory).read_text()
    assert "Temperature and heating" in page and "Temperature of the floor" not in page


@pytest.mark.thorough
def test_a_heated_floor_draws_a_map_and_heats_only_where_there_are_heaters(tmp_path):
    floor = ROOM.replace("[1, 1]", "[8, 6]") + "[[model.heaters]]\nx = [0.0, 2.0]\ny = [0.0, 6.0]\n"
    outcome, data = solved(tmp_path, floor)
    assert data.temperature.shape == (25, 8, 6) and np.all(data.heating.values[:, 2:] == 0.0)
    assert data.heating_max[0] == pytest.approx(80 * 12 / 1e3)
    # The balance of heat over the run, with the mean outdoor temperature in each interval.
    assert np.all(data.coldest <= data.mean_temperature) and np.all(
        data.mean_temperature <= data.warmest
    )
    page = build_report(outcome.directory).read_text()
    assert "Temperature of the floor" in page and 'type="range"' in page


@pytest.mark.thorough
def test_tension_of_steel_has_the_closed_form_of_its_overstress(tmp_path):
    """Yield at 3Gėt = σ_y; then the overstress is 3Gėτ(1 − e^{−(t − t_y)/τ}), and relaxes at rest."""
    outcome, data = solved(tmp_path, STEEL)
    G, tau, rate, limit = 80e3, 0.05, 0.004, 250.0
    t, t_y = data.time.values, limit / (3 * G * rate)
    top = 3 * G * rate * tau
    loading = np.where(t < t_y, 3 * G * rate * t, limit + top * -np.expm1(-(t - t_y) / tau))
    at_hold = limit + top * -np.expm1(-(1.0 - t_y) / tau)
    hold = limit + (at_hold - limit) * np.exp(-(t - 1.0) / tau)
    exact = np.where(t <= 1.0, loading, hold)
    np.testing.assert_allclose(data.equivalent_stress, exact, atol=1e-2)
    np.testing.assert_allclose(data.stress_11, 2 / 3 * exact, atol=1e-2)
    np.testing.assert_allclose(data.stress_22, -exact / 3, atol=1e-2)
    assert outcome.summary["peak_stress"]["value"] == pytest.approx(at_hold, abs=1e-2)
    assert outcome.summary["overstress"]["value"] == pytest.approx(
        np.sqrt(2 / 3) * (at_hold - limit), abs=1e-2
    )
    page = build_report(outcome.directory).read_text()
    assert "Stress over strain" in page and "The stress path and the yield surface" in page


@pytest.mark.thorough
def test_inputs_of_predictive_control_solve_the_programme_of_scipy(tmp_path):
    outcome, data = solved(
        tmp_path, PLANT + 'reference = "reference.csv"\nreference_kind = "constant"\n'
    )
    A, B, N, step = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.array([[0.0], [1.0]]), 3, 0.25
    both = expm(step * np.block([[A, B], [np.zeros((1, 3))]]))
    F, g = both[:2, :2], both[:2, 2:]
    cost = solve_discrete_are(F, g, np.eye(2), [[0.1]])
    root = np.linalg.cholesky(cost).T

    def first(x, wanted):
        """min Σ|xₖ − w|² + 0.1(uₖ − u_w)² + terminal cost, as bounded least squares in U."""
        rows, right, now, effect = [], [], np.array(x), np.zeros((2, N))
        for k in range(N):
            now, effect = F @ now, F @ effect
            effect[:, k] += g[:, 0]
            weight = root if k == N - 1 else np.eye(2)
            rows.append(weight @ effect)
            right.append(weight @ (np.array([wanted, 0.0]) - now))
        rows.append(np.sqrt(0.1) * np.eye(N))
        right.append(
            np.sqrt(0.1) * np.full(N, wanted)
        )  # the input that holds a place is that place
        return lsq_linear(
            np.concatenate(rows), np.concatenate(right), (-0.3, 0.3), "bvls", tol=1e-14
        ).x[0]

    states = np.stack([data.place, data.speed], axis=1)
    wanted = np.where(data.time < 3.0, 0.2, -0.1)
    moves = [first(x, w) for x, w in zip(states, wanted, strict=True)]
    np.testing.assert_allclose(data.input_force, moves, atol=1e-8)
    assert (
        outcome.summary["largest_force"]["value"] == pytest.approx(0.3) == data.input_max_force[0]
    )

    def closed_loop(t, x, w):
        return A @ x + B[:, 0] * first(x, w)

    x, ends = states[0], []
    for a, b, w in ((0.0, 3.0, 0.2), (3.0, 6.0, -0.1)):
        x = solve_ivp(closed_loop, (a, b), x, "RK45", args=(w,), rtol=1e-9, atol=1e-11).y[:, -1]
        ends.append(x)
    np.testing.assert_allclose(states[[10, 20]], ends, atol=1e-6)
    assert outcome.summary["decay_rate"]["value"] > 0
    assert "The plant under predictive control" in build_report(outcome.directory).read_text()


@pytest.mark.thorough
@pytest.mark.parametrize("name", MODELS)
def test_a_resumed_run_of_a_ready_model_is_that_of_one_that_was_not_interrupted(name, tmp_path):
    config = write(tmp_path, MODELS[name] + OUTPUT)
    assert run(read_config(config), tmp_path / "whole").exit_code == 0
    stopped = run(read_config(config), tmp_path / "part", on_event=Stops(4, KeyboardInterrupt()))
    assert stopped.exit_code == 130
    moved = Path(shutil.move(tmp_path / "part", tmp_path / "moved"))
    assert go_on(moved).exit_code == 0
    assert results(moved) == results(tmp_path / "whole")


def drawn(name: str, seed: int) -> str:
    """A configuration with parameters from plausible ranges."""
    rng = np.random.default_rng(seed)

    def number(low: float, high: float) -> str:
        return f"{np.exp(rng.uniform(np.log(low), np.log(high))):.6g}"

    if name == "mpc":
        pole, damping, limit = number(0.2, 5.0), number(0.05, 2.0), number(0.05, 5.0)
        return (
            PLANT.replace("-1.0, -0.4", f"-{pole}, -{damping}")
            .replace("0.3", limit)
            .replace("R = [0.1]", f"R = [{number(0.02, 10.0)}]\nstep = {number(0.05, 0.5)}")
        )
    if name == "thermostat":
        return ROOM + "".join(
            f"{key} = {number(*span)}\n"
            for key, span in (
                ("capacity", (5.0, 200.0)),
                ("loss", (0.3, 10.0)),
                ("gain", (5.0, 500.0)),
                ("power_max", (20.0, 300.0)),
                ("initial", (5.0, 30.0)),
                ("diffusivity", (0.01, 50.0)),
            )
        )
    cone = seed % 2
    numbers = (
        {"friction": (0.2, 1.5), "tension": (0.01, 50.0)} if cone else {"strength": (20.0, 900.0)}
    )
    spans = {
        "bulk_modulus": (1e3, 3e5),
        "shear_modulus": (1e3, 2e5),
        "relaxation_time": (1e-3, 10.0),
    }
    lines = "".join(f"{key} = {number(*span)}\n" for key, span in (spans | numbers).items())
    return STEEL + f'yield_condition = "{("von-mises", "drucker-prager")[cone]}"\n' + lines


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("name", MODELS)
def test_ready_models_run_for_parameters_in_plausible_ranges(name, seed, tmp_path):
    model = model_of(tmp_path, drawn(name, seed))
    plan = model.plan(lambda words: None)
    end = join_pieces(list(segments(plan)))
    bound = model.bound(end, None)
    rows = model.rows(end, bound, len(plan.times))
    found = model.results({key: v.values for key, v in rows.items()}, end, bound)
    for key, figure in found.figures.items():
        if key != "error_bound":  # infinite where no constants are small enough
            assert np.all(np.isfinite(np.asarray(figure.value, float))), key
    if name == "mpc":
        force = rows["input_force"].values
        assert np.all(np.abs(force) <= rows["input_max_force"].values + 1e-12)
    elif name == "thermostat":
        heating = rows["heating_power"].values
        assert np.all(heating >= -1e-9)
        assert np.all(heating <= rows["heating_max"].values + 1e-9)
    else:
        assert np.all(np.diff(rows["time"].values) > 0)
        assert found.figures["overstress"].value >= 0.0
