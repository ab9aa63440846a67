"""The reader of RTS-GMLC folders: a small system, read correctly, and with errors of every kind."""

import datetime

import numpy as np
import pytest

import dvax
from dvax.formats import read_rts
from dvax.models.market import Market

HEAD = "GEN UID,Bus ID,Unit Type,Fuel,PMax MW,Fuel Price $/MMBTU,HR_incr_1,HR_incr_2,HR_incr_3"
UNITS = [
    "101_CC_1,101,CC,NG,300,4.0,7000,7200,7500",
    "102_WIND_1,102,WIND,Wind,150,0,0,0,0",
    "201_CT_1,201,CT,Oil,50,10.0,9500,9600,11500",
    "201_NUC_1,201,NUCLEAR,Nuclear,200,0.8,0,0,0",
    "202_PV_1,202,PV,Solar,80,0,0,0,0",
    "201_HYDRO_1,201,HYDRO,Hydro,500,0,NA,NA,NA",
]
CLOCK = "Year,Month,Day,Period"
HOURS = 30


def clock(k):
    at = datetime.datetime(2021, 3, 14) + datetime.timedelta(hours=k)
    return f"{at.year},{at.month},{at.day},{at.hour + 1}"


def hourly(names, row):
    return [f"{CLOCK},{names}", *(f"{clock(k)},{row(k)}" for k in range(HOURS))]


def write(folder, changes=(), places=None):
    """The system in a folder, with some lines replaced: (file, line, text), None to leave it out."""
    files = {
        "gen.csv": [HEAD, *UNITS],
        "DAY_AHEAD_regional_Load.csv": hourly("1,2", lambda k: f"{250 + 5 * k},{150 + k}.5"),
        "DAY_AHEAD_wind.csv": hourly("102_WIND_1", lambda k: f"{(7 * k) % 150}.25"),
        "DAY_AHEAD_pv.csv": hourly("202_PV_1", lambda k: f"{max(0, 80 - 4 * abs(k - 12))}"),
    }
    for file, line, text in changes:
        files[file][line - 1] = text
    for file, lines in files.items():
        path = folder / (places or {}).get(file, file)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(line for line in lines if line is not None) + "\n", "utf-8")
    return folder


def test_rts_folder_of_a_small_system_is_read_exactly(tmp_path):
    rts = read_rts(write(tmp_path))
    assert rts.names == ("101_CC_1", "201_CT_1", "201_NUC_1", "102_WIND_1", "202_PV_1")
    assert rts.area.tolist() == [1, 2, 2, 1, 2]
    np.testing.assert_allclose(rts.cost, [28.0, 95.0, 0.0, 0.0, 0.0])
    # 500 · 4/1000/300; 2000 · 10/1000/50; the flat ones have the least slope.
    np.testing.assert_allclose(rts.slope, [2.0 / 300, 0.4, 1e-3, 1e-3, 1e-3])
    assert rts.start == datetime.datetime(2021, 3, 14)
    np.testing.assert_allclose(rts.load, 400.5 + 6.0 * np.arange(30))
    np.testing.assert_allclose(rts.capacity[10], [300.0, 50.0, 200.0, 70.25, 72.0])


def test_rts_checkout_of_the_repository_is_read(tmp_path):
    series = "RTS_Data/timeseries_data_files"
    places = {
        "gen.csv": "RTS_Data/SourceData/gen.csv",
        "DAY_AHEAD_regional_Load.csv": f"{series}/Load/DAY_AHEAD_regional_Load.csv",
        "DAY_AHEAD_wind.csv": f"{series}/WIND/DAY_AHEAD_wind.csv",
        "DAY_AHEAD_pv.csv": f"{series}/PV/DAY_AHEAD_pv.csv",
    }
    one, two = read_rts(write(tmp_path / "a")), read_rts(write(tmp_path / "b", places=places))
    np.testing.assert_array_equal(one.capacity, two.capacity)


def test_market_from_rts_covers_a_range_of_hours(tmp_path):
    rts = read_rts(write(tmp_path))
    market = Market.from_rts(rts, 4, 6)
    b = 40.0 / (0.3 * rts.load.mean())
    assert float(market.b) == pytest.approx(b, rel=1e-15)
    for t in (4.0, 6.25, 9.0):
        load = np.interp(t, np.arange(30), rts.load)
        assert float(market.intercept(t)) == pytest.approx(40.0 + b * load)
    np.testing.assert_allclose(
        np.asarray(market.capacity(6.5)), 0.5 * (rts.capacity[6] + rts.capacity[7])
    )
    assert market.intercept.span() == (4.0, 9.0) and market.firms.shape == (5, 2)
    assert np.isnan(float(market.intercept(9.5)))  # no extrapolation


@pytest.mark.parametrize("hours", [(-1, 5), (0, 1), (0, 31), (25, 6), (0.0, 5), (True, 5)])
def test_market_from_rts_rejects_missing_hours(tmp_path, hours):
    with pytest.raises(dvax.InputError, match="the hours 0 to 29"):
        Market.from_rts(write(tmp_path), *hours)


LOAD, WIND, PV = "DAY_AHEAD_regional_Load.csv", "DAY_AHEAD_wind.csv", "DAY_AHEAD_pv.csv"
BAD = [
    ("gen.csv", 1, HEAD.replace("PMax MW", "PMax kW"), "gen.csv, line 1", "Did you mean 'PMax kW'"),
    ("gen.csv", 1, HEAD.replace("HR_incr_3", "HR_3"), "gen.csv, line 1", "no column 'HR_incr_3'"),
    ("gen.csv", 1, HEAD.replace("Fuel,", "Bus ID,"), "gen.csv, line 1", "2 times"),
    ("gen.csv", 2, "101_CC_1,101,CC,NG,-300,4.0,7000,7200,7500", "gen.csv, line 2", "≥ 0"),
    ("gen.csv", 2, "101_CC_1,101,CC,NG,0,4.0,7000,7200,7500", "gen.csv, line 2", "has a capacity"),
    ("gen.csv", 2, "101_CC_1,101,CC,NG,big,4.0,7000,7200,7500", "gen.csv, line 2", "finite decimal"),
    ("gen.csv", 2, "101_CC_1,101,CC,NG,300,4.0,7000,7200", "gen.csv, line 2", "8 cells"),
    ("gen.csv", 2, "101_CC_1,101,CC,NG,300,4.0,7000,7200,NA", "gen.csv, line 2", "finite decimal"),
    ("gen.csv", 2, "101_CC_1,101,CC,NG,300,4.0,7000,7200,6000", "gen.csv, line 2", "must not fall"),
    ("gen.csv", 2, "101_CC_1,101,FUSION,NG,300,4.0,7000,7200,7500", "gen.csv, line 2", "one of CT"),
    ("gen.csv", 2, "101_CC_1,1,CC,NG,300,4.0,7000,7200,7500", "gen.csv, line 2", "three digits"),
    ("gen.csv", 2, "101_CC_1,501,CC,NG,300,4.0,7000,7200,7500", "gen.csv, line 2", "areas are those"),
    ("gen.csv", 3, UNITS[0], "gen.csv, line 3", "listed once"),
    ("gen.csv", 3, "109_WIND_9,102,WIND,Wind,150,0,0,0,0", "gen.csv, line 3", "must be a column"),
    (WIND, 1, f"{CLOCK},109_WIND_9", f"{WIND}, line 1", "of the type WIND"),
    (WIND, 1, f"{CLOCK},202_PV_1", f"{WIND}, line 1", "of the type WIND"),
    (WIND, 5, f"{clock(3)},-1.0", f"{WIND}, line 5", "≥ 0"),
    (WIND, 5, f"{clock(3)},nan", f"{WIND}, line 5", "finite decimal"),
    (WIND, 5, f"{clock(3)},", f"{WIND}, line 5", "a gap is not a value"),
    (WIND, 5, f"{clock(3)},140000", f"{WIND}, line 5", "kW to MW"),
    (PV, 7, f"{clock(6)},10", f"{PV}, line 7", "an hour apart"),
    (PV, 7, None, f"{PV}, line 7", "an hour apart"),
    (PV, 7, "2021,3,14,25,10", f"{PV}, line 7", "periods 1 to 24"),
    (PV, 7, "2021,2,30,5,10", f"{PV}, line 7", "must be an hour"),
    (PV, 31, None, PV, "29 hours"),
    (LOAD, 2, f"{clock(0)},250e3,150e3", LOAD, "mixed units"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "line", "text", "place", "says"), BAD)
def test_rts_errors_name_file_line_and_fix(tmp_path, file, line, text, place, says):
    with pytest.raises(dvax.InputError) as caught:
        read_rts(write(tmp_path, [(file, line, text)]))
    told = [str(problem) for problem in caught.value.problems]
    assert any(one.startswith(place) and says in one for one in told), told


def test_rts_errors_are_reported_at_once(tmp_path):
    changes = [(file, line, text) for file, line, text, *_ in (BAD[3], BAD[17], BAD[22], BAD[25])]
    with pytest.raises(dvax.InputError) as caught:
        read_rts(write(tmp_path, changes))
    text = str(caught.value)
    assert all(file in text for file in ("gen.csv", WIND, PV)), text


def test_rts_errors_of_one_column_are_limited_to_twenty_messages(tmp_path):
    """A shifted column gives twenty messages and one summary."""
    changes = [(WIND, k, f"{clock(k - 2)},gone") for k in range(2, 32)]
    with pytest.raises(dvax.InputError) as caught:
        read_rts(write(tmp_path, changes))
    assert len(caught.value.problems) == 21


def test_rts_missing_files_are_all_named(tmp_path):
    write(tmp_path)
    (tmp_path / "gen.csv").unlink()
    (tmp_path / PV).unlink()
    with pytest.raises(dvax.InputError) as caught:
        read_rts(tmp_path)
    assert len(caught.value.problems) == 2 and "no gen.csv" in str(caught.value)
    (tmp_path / "gen.csv").write_text("", "utf-8")
    (tmp_path / PV).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(dvax.InputError) as caught:
        read_rts(tmp_path)
    assert "0 rows" in str(caught.value) and "UTF-8" in str(caught.value)
