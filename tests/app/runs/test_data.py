"""Measured data are read exactly, or rejected with file, line and column."""

import io
import pickle
from pathlib import Path

import numpy as np
import pytest

from dvax.app.runs.config import build_contact, load_config
from dvax.errors import InputError

from .example import LOAD, write

EL_CENTRO = Path(__file__).parents[4] / "shared" / "data" / "elCentro.at2"


def problems_of(path):
    with pytest.raises(InputError) as caught:
        load_config(path)
    return caught.value.problems


def test_series_times_and_values_are_converted(tmp_path):
    """Nonuniform times are kept."""
    table = (
        '# a comment\ntime [ms], "load [mm/s]",note []\n\n0,1e-3,a\n500,+2.E-3,b\n2000,-.5,"c,d"\n'
    )
    changes = {"load": {"series": {"file": "other.csv", "column": "load"}}}
    inputs = build_contact(load_config(write(tmp_path, changes, other_csv=table)))
    assert inputs.load.series is not None
    np.testing.assert_allclose(inputs.load.series.times, [0, 0.5, 2.0], rtol=1e-15)
    np.testing.assert_allclose(inputs.load.series.values, [1, 2, -500], rtol=1e-15)
    np.testing.assert_allclose(inputs.load_signal.knots(), [0, 0.5, 2.0], rtol=1e-15)


def test_series_without_unit_is_scaled_by_per_unit(tmp_path):
    table = "t [s],level [1]\n0,1\n2,3\n"
    series = {"file": "r.csv", "time_column": "t", "per_unit": "30 mm/s"}
    inputs = build_contact(load_config(write(tmp_path, {"load": {"series": series}}, r_csv=table)))
    assert float(inputs.load_signal(1.0)) == pytest.approx(60e3, rel=1e-14)


FLAWS = {
    "gap": ("time [s],load [um/s]\n0,1\n1,\n3,2\n", "line 3, column 'load'", "an empty cell"),
    "text": ("time [s],load [um/s]\n0,1\n1,x\n3,2\n", "line 3, column 'load'", "'x'"),
    "nan": ("time [s],load [um/s]\n0,1\n1,nan\n3,2\n", "line 3, column 'load'", "'nan'"),
    "inf": ("time [s],load [um/s]\n0,1\n1,1e999\n3,2\n", "line 3, column 'load'", "'1e999'"),
    "underscore": ("time [s],load [um/s]\n0,1\n1,1_0\n3,2\n", "line 3, column 'load'", "'1_0'"),
    "reversed": (
        "time [s],load [um/s]\n0,1\n2,1\n1,1\n3,2\n",
        "line 4, column 'time'",
        "1 after 2",
    ),
    "repeated": (
        "time [s],load [um/s]\n0,1\n2,1\n2,1\n3,2\n",
        "line 4, column 'time'",
        "2 after 2",
    ),
    "ragged": ("time [s],load [um/s]\n0,1\n1\n3,2\n", "line 3", "1 cells"),
    "decimal comma": ("time [s],load [um/s]\n0,1\n1,2,5\n3,2\n", "line 3", "3 cells"),
    "no unit": ("time [s],load\n0,1\n3,2\n", "line 1, column 'load'", "names its unit"),
    "no time unit": ("time,load [um/s]\n0,1\n3,2\n", "line 1, column 'time'", "names its unit"),
    "wrong unit": (
        "time [s],load [um]\n0,1\n3,2\n",
        "column 'load'",
        "an indentation rate, in um/s",
    ),
    "unknown unit": ("time [s],load [foo]\n0,1\n3,2\n", "column 'load'", "not a known unit"),
    "wrong time unit": ("time [m],load [um/s]\n0,1\n3,2\n", "column 'time'", "a time, in s"),
    "no header": ("0,1\n3,2\n", "line 1", "names each column"),
    "no data": ("time [s],load [um/s]\n", "load.csv", "no data"),
    "empty": ("\n\n", "load.csv", "no rows"),
    "one row": ("time [s],load [um/s]\n0,1\n", "load.csv", "needs 2"),
    "other columns": (
        "time [s],laod [um/s],b [1]\n0,1,1\n3,2,1\n",
        "line 1",
        "exactly one besides",
    ),
    "no time": ("when [s],load [um/s]\n0,1\n3,2\n", "line 1", "no column 'time'"),
    "same name": ("time [s],a [1],a [1]\n0,1,1\n3,2,1\n", "line 1", "2 times"),
    "ends early": ("time [s],load [um/s]\n0,1\n1.9,2\n", "run.toml: load.series", "0 to 1.9 s"),
    "starts late": ("time [s],load [um/s]\n0.1,1\n3,2\n", "run.toml: load.series", "extrapolated"),
    "quotes": ('time [s],load [um/s]\n0,"1\n3,2\n', "line", "quotes|cells|every line"),
}


@pytest.mark.parametrize("case", FLAWS)
def test_data_flaw_is_named_with_its_place(case, tmp_path):
    table, place, said = FLAWS[case]
    first = problems_of(write(tmp_path, load_csv=table))[0]
    assert place in first.place and "load" in first.place, first
    assert any(part in str(first) for part in said.split("|")), first


def test_data_flaws_are_reported_up_to_twenty(tmp_path):
    rows = ["0,1", "1,", "2,x", "3", "4,nan"]
    found = problems_of(write(tmp_path, load_csv="\n".join(["time [s],load [um/s]", *rows])))
    assert [p.place for p in found] == [
        "load.csv, line 5",
        "load.csv, line 3, column 'load'",
        "load.csv, line 4, column 'load'",
        "load.csv, line 6, column 'load'",
    ]
    bad = "time [s],load [um/s]\n" + "1,x\n" * 500
    assert len(problems_of(write(tmp_path, load_csv=bad))) == 21


def test_data_bytes_that_are_not_text_are_rejected(tmp_path):
    assert "UTF-8" in str(problems_of(write(tmp_path, load_csv=b"time [s],load [um/s]\n\xff"))[0])


def test_missing_column_error_names_the_nearest(tmp_path):
    table = LOAD.replace("load", "left_load")
    changes = {"load.series": {"file": "load.csv", "column": "left_laod"}}
    (problem,) = problems_of(write(tmp_path, changes, load_csv=table))
    assert problem.fix.startswith("Did you mean 'left_load'?")


def test_series_may_end_before_the_run_by_rounding_only(tmp_path):
    # 0.1 min is 6.000000000000001 or 5.999999999999999 s in some order of multiplications.
    for unit, last in (("min", "0.1"), ("hour", repr(0.1 / 60)), ("ms", "6000")):
        table = f"time [{unit}],load [um/s]\n0,1\n{last},2\n"
        config = load_config(write(tmp_path, {"time.end": 6.0}, load_csv=table))
        assert np.isfinite(build_contact(config).load_signal(6.0)).all(), unit


def npy(array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def test_profile_of_wrong_length_names_both_lengths(tmp_path):
    changes = {"demand.profile.file": "other.npy"}
    (problem,) = problems_of(write(tmp_path, changes, other_npy=npy(np.ones(5))))
    assert "5 values" in problem.given and "8 points" in problem.rule
    initial = {"initial.profile.file": "other.npy"}
    (problem,) = problems_of(write(tmp_path, initial, other_npy=npy(np.ones(9))))
    assert problem.place == "run.toml: initial.profile.file"
    assert "9 values" in problem.given and "8 points" in problem.rule


def test_npy_arrays_are_validated_and_never_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    boxed = np.empty(8, dtype=object)
    boxed[:] = [Trap()] * 8
    cases = {
        "pickled objects": pickle.dumps(Trap()),
        "pickle": npy(boxed),
        "truncated": npy(np.ones(8))[:-3],
        "empty": b"",
        "text": b"hello",
        "real numbers": npy(np.ones(8, dtype=complex)),
        "value 3": npy(np.array([1, 1, np.nan, 1, 1, 1, 1, 1])),
    }
    for name, content in cases.items():
        found = problems_of(write(tmp_path, {"demand.profile.file": "o.npy"}, o_npy=content))
        assert len(found) == 1, name
        if name in ("real numbers", "value 3"):
            assert name in str(found[0])
    assert not (tmp_path / "sprung").exists()


def test_profile_is_interpolated_and_not_extrapolated(tmp_path):
    changes = {"demand": {"profile": {"file": "p.csv"}}}
    table = "s [cm],height [mm]\n0,0\n1,0.01\n2,0\n"
    inputs = build_contact(load_config(write(tmp_path, changes, p_csv=table)))
    s = inputs.boundary.coordinates[0]
    np.testing.assert_allclose(inputs.demand_signal(0.0), 10 - np.abs(s - 10), rtol=1e-13)
    short = "s [cm],height [mm]\n0,0\n1,0.01\n"
    (problem,) = problems_of(write(tmp_path, changes, p_csv=short))
    assert "nothing is extrapolated" in problem.rule and "18.75" in problem.rule


def test_profile_array_over_a_rectangle(tmp_path):
    changes = {
        "boundary": {"lengths": [2.0, 3.0], "points": [2, 4]},
        "demand": {"profile": {"file": "p.npy"}},
        "load": {"value": 0.0},
    }
    array = np.arange(8.0).reshape(2, 4)
    inputs = build_contact(load_config(write(tmp_path, changes, p_npy=npy(array))))
    np.testing.assert_array_equal(inputs.demand_signal(0.0), np.arange(8.0))
    (problem,) = problems_of(write(tmp_path, changes, p_npy=npy(array.T)))
    assert "(4, 2)" in problem.given and "(2, 4)" in problem.rule


AT2 = """A record
The units are (g)
NPTS=  5, DT= .50000 SEC
   0.00100   0.00200  -0.00300
 4.0E-03   0.00500
"""
MOTION = {"load": {"series": {"file": "r.at2", "per_unit": "30 um/s"}}}


def test_at2_record_is_read(tmp_path):
    for text in (AT2, AT2 + "*** End Data ***\n", AT2.replace("The units are (g)", "UNITS OF G")):
        inputs = build_contact(load_config(write(tmp_path, MOTION, r_at2=text)))
        signal = inputs.load_signal
        np.testing.assert_allclose(signal.knots(), [0, 0.5, 1, 1.5, 2], rtol=1e-15)
        np.testing.assert_allclose(signal(1.25), 30 * (-0.003 + 0.004) / 2, rtol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "place", "said"),
    [
        ("NPTS=  5", "NPTS=  6", "r.at2, line 3", "NPTS=6 and 5 values"),
        ("NPTS=  5,", "points", "r.at2", "without NPTS="),
        ("(g)", "(cm/s2)", "r.at2", "units of g"),
        ("0.00200", "0.0x200", "r.at2, line 4", "'0.0x200' at column 14"),
        ("0.00200", "nan", "r.at2, line 4", "'nan'"),
        (".50000 SEC", ".50000 MIN", "r.at2, line 3", "in seconds"),
        (".50000 SEC", "0.0 SEC", "r.at2, line 3", "positive step"),
    ],
)
def test_at2_record_with_errors_is_rejected(old, new, place, said, tmp_path):
    problem = problems_of(write(tmp_path, MOTION, r_at2=AT2.replace(old, new)))[0]
    assert problem.place.startswith(place) and said in str(problem), problem


def test_at2_record_requires_per_unit(tmp_path):
    changes = {"load": {"series": {"file": "r.at2"}}}
    (problem,) = problems_of(write(tmp_path, changes, r_at2=AT2))
    assert problem.place == "run.toml: load.series.per_unit"
    assert 'per_unit = "30 um/s"' in problem.fix


@pytest.mark.skipif(
    not EL_CENTRO.exists(), reason="the El Centro record is not beside the checkout"
)
def test_at2_el_centro_record_is_read(tmp_path):
    changes = {
        "load": {"series": {"file": "elCentro.at2", "per_unit": "30 um/s"}},
        "time.end": 31.16,
    }
    path = write(tmp_path, changes)
    (tmp_path / "elCentro.at2").write_bytes(EL_CENTRO.read_bytes())
    series = build_contact(load_config(path)).load.series
    assert series is not None and series.times.size == 1559
    assert series.times[-1] == pytest.approx(31.16)
    # The published peak acceleration of the north-south component.
    assert np.max(np.abs(series.values)) / 30 == pytest.approx(0.319, abs=1e-3)


def test_data_file_that_is_too_large_is_rejected(tmp_path, monkeypatch):
    monkeypatch.setattr("dvax.app.runs.data_file.MAX_BYTES", 20)
    found = problems_of(write(tmp_path))
    assert any("at most 20" in p.rule for p in found)
