"""A configuration determines a run completely, in numbers with known units."""

import time

import jax
import numpy as np
import pytest
import tomli_w

from dvax.app.runs.config import build_contact, load_config
from dvax.app.runs.resolved import write_resolved
from dvax.app.runs.units import converted
from dvax.errors import InputError

from .example import LOAD, REMOVE, STRIP, write


def test_config_fields_are_products_of_their_factors(tmp_path):
    inputs = build_contact(load_config(write(tmp_path)))
    s = (np.arange(8) + 0.5) * 2.5
    np.testing.assert_allclose(inputs.boundary.coordinates[0], s, rtol=1e-15)
    np.testing.assert_allclose(inputs.boundary.weights, 2.5, rtol=1e-15)
    for t, record in ((0.0, 0.5), (0.35, 1.0), (0.85, 0.625), (2.0, 1 / 1.5 * 1.25 - 0.25)):
        demand, load = inputs.demand_signal(t), inputs.load_signal(t)
        np.testing.assert_allclose(demand, STRIP * (1 + 0.1 * np.sin(t)), rtol=1e-14)
        np.testing.assert_allclose(load, record * (1 + 0.3 * np.cos(s)), rtol=1e-13)
    np.testing.assert_array_equal(inputs.frame_times, [0, 0.5, 1, 1.5, 2])
    np.testing.assert_array_equal(inputs.x0, np.zeros(8))
    traced = jax.jit(lambda t: inputs.load_signal(t))(0.35)
    np.testing.assert_allclose(traced, inputs.load_signal(0.35), rtol=1e-14)


def test_config_default_companion_crosses_the_active_regime(tmp_path):
    inputs = build_contact(load_config(write(tmp_path)))
    # b_x dx = (1 + b_u) kappa0 / beta is the width of the active regime in the drive q.
    np.testing.assert_allclose(0.8 * (inputs.companion_x0 - inputs.x0), 1.6 * 2.0 / 2.0)


@pytest.mark.parametrize(
    ("text", "unit", "number"),
    [
        ("12 L/s", "m^3/s", 0.012), ("7 mN", "N", 0.007), ("0.3 kN", "N", 300.0),
        ("36 km/h", "m/s", 10.0),
        ("1.1 mm", "m", 0.0011), ("2.2 ms", "s", 0.0022), ("1e-3 MPa", "Pa", 1000.0),
    ],
)  # fmt: skip
def test_a_decimal_quantity_is_converted_to_the_nearest_number(text, unit, number):
    assert converted(text, unit) == number


def test_config_quantities_with_units_are_converted(tmp_path):
    plain = load_config(write(tmp_path))
    quantities = {
        "model.alpha": "60 1/min",
        "model.beta": "2 GPa/mm",
        "model.kappa0": "2000 kPa",
        "model.d_x": "0.3 Hz",
        "boundary.length": "2 cm",
        "time.end": "2000 ms",
    }
    other = load_config(write(tmp_path, quantities))
    for section in ("model", "boundary", "time"):
        a, b = getattr(plain, section).model_dump(), getattr(other, section).model_dump()
        assert a.keys() == b.keys()
        for key, value in a.items():
            assert b[key] == (pytest.approx(value, rel=1e-14) if type(value) is float else value), (
                key
            )


def test_config_working_units_do_not_change_the_physics(tmp_path):
    """The same strip in seconds and millimetres, and in minutes and metres."""
    inputs = build_contact(load_config(write(tmp_path)))
    units = {"time": "min", "length": "m", "indentation": "nm", "pressure": "Pa"}
    changes = {
        "units": units,
        "model.alpha": "1 1/s",
        "model.beta": "2 MPa/um",
        "model.d_x": "0.3 1/s",
        "model.d_u": "0.5 1/s",
        "model.kappa0": "2 MPa",
        "boundary.length": "20 mm",
        "load.expression": "1 + 0.3*cos(1000*s)",
        "demand.expression": "1 + 0.1*sin(60*t)",
        "time.end": "2 s",
    }
    other = build_contact(load_config(write(tmp_path, changes)))
    to_nm, to_nm_per_min = 1e3, 60e3
    np.testing.assert_allclose(
        other.demand_signal(1.4 / 60), to_nm * inputs.demand_signal(1.4), rtol=1e-12
    )
    np.testing.assert_allclose(
        other.load_signal(1.4 / 60), to_nm_per_min * inputs.load_signal(1.4), rtol=1e-12
    )
    np.testing.assert_allclose(other.companion_x0, to_nm * inputs.companion_x0, rtol=1e-12)


def test_config_resolved_file_gives_the_same_run_elsewhere(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    changes = {"initial.expression": "sin(s)", "demand.knots": [0.5], "load.series.kind": "cubic"}
    config = load_config(write(tmp_path / "a", changes))
    inputs = build_contact(config)
    again = load_config(write_resolved(config, tmp_path / "b"))
    for section in ("units", "model", "boundary", "initial", "time", "solver", "output"):
        assert getattr(again, section) == getattr(config, section), section
    copied = build_contact(again)
    np.testing.assert_array_equal(copied.companion_x0, inputs.companion_x0)
    np.testing.assert_array_equal(copied.load_signal(0.9), inputs.load_signal(0.9))
    np.testing.assert_array_equal(copied.demand_signal(0.9), inputs.demand_signal(0.9))
    assert {f.sha256 for f in copied.data_files} == {f.sha256 for f in inputs.data_files}
    for text in ("frames = 4", "atol = ", "companion = ", 'kind = "cubic"'):
        assert text in tomli_w.dumps(again.tree())


def test_config_rectangle_has_points_in_c_order(tmp_path):
    changes = {
        "boundary": {"lengths": [4.0, "3 mm"], "points": [2, 3]},
        "demand": {"expression": "s1 + 10*s2"},
        "load": {"value": "1 mm/s"},
    }
    inputs = build_contact(load_config(write(tmp_path, changes)))
    assert inputs.boundary.shape == (2, 3)
    np.testing.assert_allclose(inputs.demand_signal(0.0), [6, 16, 26, 8, 18, 28])
    assert float(np.sum(inputs.boundary.weights)) == pytest.approx(12.0)
    assert float(inputs.load_signal(0.0)) == pytest.approx(1000.0)
    assert inputs.boundary.nearest((1.0, 2.5)) == 2


def test_config_midpoint_weights_are_of_second_order(tmp_path):
    errors = []
    for n in (20, 40):
        changes = {"boundary.points": n, "demand": {"expression": "exp(s/20)"}}
        inputs = build_contact(load_config(write(tmp_path, changes)))
        integral = float(np.sum(inputs.boundary.weights * inputs.demand_signal(0.0)))
        errors.append(20 * (np.e - 1) - integral)
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.02)


def test_config_nodes_from_a_file(tmp_path):
    changes = {"boundary": {"file": "nodes.csv"}, "demand": {"expression": "s"}}
    nodes = "s [cm],weight [mm]\n0.1,0.5\n0.3,2\n0.35,0.25\n"
    inputs = build_contact(load_config(write(tmp_path, changes, nodes_csv=nodes)))
    np.testing.assert_allclose(inputs.demand_signal(0.0), [1, 3, 3.5])
    np.testing.assert_allclose(inputs.boundary.weights, [0.5, 2, 0.25])


def test_config_points_of_interest_snap_with_a_note(tmp_path):
    changes = {"output.points_of_interest": ["0.5 cm", 6.25]}
    inputs = build_contact(load_config(write(tmp_path, changes)))
    assert [inputs.boundary.nearest((s,)) for s in (5.0, 6.25)] == [1, 2]
    assert len(inputs.notices) == 1 and "nearest point is [3.75] mm" in inputs.notices[0]


def test_config_demand_with_a_jump_gives_a_note(tmp_path):
    series = {"file": "load.csv", "kind": "constant", "per_unit": "1 um"}
    inputs = build_contact(load_config(write(tmp_path, {"demand": {"series": series}})))
    assert any("continuous in time" in notice for notice in inputs.notices)


def test_config_knots_of_a_formula_reach_the_signal(tmp_path):
    demand = {"expression": "where(t < 1, t, 1)", "knots": ["1000 ms"]}
    signal = build_contact(load_config(write(tmp_path, {"demand": demand}))).demand_signal
    np.testing.assert_allclose(signal.knots(), [1.0])


WRONG = {
    "unknown section": ({"bondary.length": 1.0}, "bondary", "Did you mean 'boundary'"),
    "unknown key": ({"model.alhpa": 1.0}, "model.alhpa", "Did you mean 'alpha'"),
    "unknown inner key": ({"load.series.colum": "x"}, "load.series.colum", "'column'"),
    "missing": ({"model.alpha": REMOVE}, "model.alpha", "it is required"),
    "missing section": ({"time": REMOVE}, "time", "it is required"),
    "model": ({"model.name": "contac"}, "model.name", "Did you mean 'contact'"),
    "kappa0": ({"model.kappa0": 0.0}, "model.kappa0", "greater than 0"),
    "beta": ({"model.beta": -2}, "model.beta", "greater than 0"),
    "b_u": ({"model.b_u": -0.1}, "model.b_u", "at least 0"),
    "quantity below the bound": ({"model.kappa0": "-2 MPa"}, "model.kappa0", "greater than 0"),
    "nan": ({"model.alpha": float("nan")}, "model.alpha", "finite"),
    "inf": ({"time.end": float("inf")}, "time.end", "finite"),
    "overflow": ({"time.end": "1e999 s"}, "time.end", "finite"),
    "bool": ({"model.d_x": True}, "model.d_x", "a number"),
    "text": ({"model.d_x": "much"}, "model.d_x", "a number and a unit"),
    "dimension": ({"model.kappa0": "2 s"}, "model.kappa0", "a pressure, in MPa"),
    "unit": ({"model.kappa0": "2 MPo"}, "model.kappa0", "not a known unit"),
    "unit bomb": ({"model.kappa0": "2 m**9**9**9"}, "model.kappa0", "is not a unit"),
    "working unit": ({"units.length": "s"}, "units.length", "no unit of length"),
    "end": ({"time.end": 0}, "time.end", "greater than 0"),
    "frames": ({"time.frames": 0}, "time.frames", "at least 1"),
    "frames real": ({"time.frames": 2.5}, "time.frames", "whole number"),
    "dt": ({"solver.dt": -1.0}, "solver.dt", "greater than 0"),
    "dt tiny": ({"solver.dt": "1e-300 s"}, "solver.dt", "cannot be counted"),
    "dt long": ({"solver.dt": 2.5}, "solver.dt", "not longer than the run"),
    "dt and rtol": ({"solver.dt": 0.1, "solver.rtol": 1e-6}, "solver", "not both"),
    "rtol": ({"solver.rtol": 1.0}, "solver.rtol", "less than 1"),
    "method": ({"solver.method": "ETD2"}, "solver.method", "Did you mean 'ETD"),
    "no boundary": ({"boundary": {}}, "boundary", "exactly one of the three"),
    "two boundaries": ({"boundary.lengths": [1, 2]}, "boundary", "exactly one of the three"),
    "points": ({"boundary.points": 0}, "boundary.points", "points"),
    "points of a plane": (
        {"boundary": {"lengths": [1, 2], "points": 3}, "load": {"value": 1.0}},
        "boundary.points",
        "each direction",
    ),
    "points of one direction": (
        {"boundary": {"lengths": [1, 2], "points": [3]}, "load": {"value": 1.0}},
        "boundary.points",
        "each direction",
    ),
    "one length": (
        {"boundary": {"lengths": [1], "points": [3, 3]}, "load": {"value": 1.0}},
        "boundary.lengths",
        "a list of at least 2",
    ),
    "lengths": (
        {"boundary": {"lengths": [1, -2], "points": [3, 3]}, "load": {"value": 1.0}},
        "boundary.lengths",
        "greater than 0",
    ),
    "no factor": ({"load": {}}, "load", "at least one of them"),
    "lonely knots": ({"load": {"value": 1.0, "knots": [1.0]}}, "load.knots", "its own"),
    "two units": ({"load.value": "1 um/s"}, "load", "only one of them carries a unit"),
    "formula": ({"load.expression": "1 + sine(t)"}, "load.expression, column 5", "'sin'"),
    "formula t in x0": ({"initial.expression": "t"}, "initial.expression, column 1", "are s"),
    "formula bomb": ({"load.expression": "9**9**9**9"}, "load.expression, column 7", "at most 64"),
    "formula not finite": (
        {"load.expression": "1/(t - 1)"},
        "load.expression|load",
        "at t = 1, s =",
    ),
    "companion": ({"initial.companion": "sin(t)"}, "initial.companion, column 5", "are s"),
    "companion zero": ({"initial.companion": 0.0}, "initial.companion", "both trajectories"),
    "interest": ({"output.points_of_interest": [50]}, "points_of_interest[1]", "off the boundary"),
    "interest no list": ({"output.points_of_interest": 5.0}, "points_of_interest", "a list"),
    "interest 2-D": (
        {"output.points_of_interest": [[1, 2]]},
        "points_of_interest[1]",
        "coordinate",
    ),
    "report": ({"output.report": 1}, "output.report", "true or false"),
    "section no table": ({"time": 3}, "time", "a table"),
}


@pytest.mark.parametrize("case", WRONG)
def test_config_errors_name_place_and_rule(case, tmp_path):
    changes, place, said = WRONG[case]
    with pytest.raises(InputError) as caught:
        load_config(write(tmp_path, changes))
    (problem,) = caught.value.problems
    assert problem.place.startswith("run.toml: "), problem
    assert any(part in problem.place for part in place.split("|")), problem
    assert any(part in str(problem) for part in said.split("|")), problem
    assert problem.given and problem.fix


def test_config_long_strings_are_rejected_fast(tmp_path):
    blanks, digits = " " * 200_000, "1" * 200_000
    start = time.perf_counter()
    for changes in (
        {"model.kappa0": "2 M" + blanks + "!"},
        {"model.kappa0": digits + "!"},
        {"model.kappa0": "2 " + "m*" * 50_000},
        {"initial.companion": "2 s" + blanks + "!"},
        {"load.expression": "(" * 100_000},
    ):
        with pytest.raises(InputError):
            load_config(write(tmp_path, changes))
    header = f"time [s],load{' ' * 100_000}!\n0,{digits[:100_000]}x\n3,1\n"
    with pytest.raises(InputError):
        load_config(write(tmp_path, load_csv=header))
    assert time.perf_counter() - start < 3.0


def places_of(path) -> list[str]:
    with pytest.raises(InputError) as caught:
        load_config(path)
    return [problem.place for problem in caught.value.problems]


def test_config_errors_of_all_tables_are_reported_at_once(tmp_path):
    changes = {
        "colour": "red",
        "units.pressure": "mm",
        "model.alpha": -1.0,
        "model.kapa0": 2.0,
        "demand.sereis": 1,
        "load.series.colum": "x",
        "initial.companion": True,
        "time.frames": 0,
        "solver.dt": -1.0,
        "output.png": "yes",
    }
    found = places_of(write(tmp_path, changes))
    assert sorted(found) == sorted(f"run.toml: {key}" for key in changes)


def test_config_errors_of_all_data_are_reported_at_once(tmp_path):
    changes = {
        "demand.expression": "sine(t)",
        "load.series.file": "none.csv",
        "load.expression": "foo",
        "initial": {"profile": {"file": "../x.csv"}, "companion": "s+"},
        "solver.dt": 2.5,
        "output.points_of_interest": [50.0],
    }
    places = "\n".join(places_of(write(tmp_path, changes)))
    for key in (*changes, "initial.profile.file", "initial.companion"):
        assert key in places, key


def test_config_toml_syntax_errors_name_line_and_column(tmp_path):
    path = tmp_path / "run.toml"
    for text, place in (
        ("[model]\nalpha = = 2\n", "run.toml, line 2, column 9"),
        ("[model\n", "run.toml, line 1, column 7"),
        ("a = 1\na = 2\n", "run.toml, line 2"),
        ("a = [" * 5000, "run.toml"),
        ("a = 1" + "0" * 5000, "run.toml"),
        ("a = 'open", "run.toml"),
    ):
        path.write_text(text)
        with pytest.raises(InputError) as caught:
            load_config(path)
        assert caught.value.problems[0].place.startswith(place), text[:20]
    path.write_bytes(b"a = '\xff'")
    with pytest.raises(InputError, match="byte 6"):
        load_config(path)
    for missing in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(InputError, match="a configuration is a TOML file"):
            load_config(missing)


def test_config_data_must_lie_in_the_folder_unless_allowed(tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    (tmp_path / "outside.csv").write_text(LOAD)
    for name in ("../outside.csv", str(tmp_path / "outside.csv")):
        path = write(inner, {"load.series.file": name})
        with pytest.raises(InputError, match="in the configuration's folder"):
            load_config(path)
        assert load_config(path, allow_outside=True).load.series.file == name
    (inner / "link.csv").symlink_to(tmp_path / "outside.csv")
    with pytest.raises(InputError, match="in the configuration's folder"):
        load_config(write(inner, {"load.series.file": "link.csv"}))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ("an empty file", "[model]", "circuit")),
        ("# nothing\n", ("an empty file",)),
        ("[output]\npng = false\n", ("no [model], but output",)),
        ("a 1", ("line 1", "'a 1'", "key = value")),
        ("a = b", ("'a = b'", "no value of TOML", "quotes")),
        ('[model]\nname = "x\n', ("line 2", "one line", "Close the quotes")),
        ("[model]\na = 1\na = 2\n", ("line 3", "'a = 2'", "occurs once")),
        ("[model]\n[model]\n", ("line 2", "[[table]]")),
        ("a = 5 ms\n", ("'a = 5 ms'", '"5 ms"')),
        ('a = "C:\\path"\n', ("backslash", "'single quotes'")),
        ("a = [1, 2\n", ("at its end", "Close the bracket")),
    ],
)
def test_config_unreadable_file_is_reported_as_a_file(tmp_path, text, words):
    from dvax.app.runs.applications.config import read_config

    file = tmp_path / "run.toml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        read_config(file)
    for word in words:
        assert word in str(caught.value)
