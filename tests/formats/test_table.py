"""Rows of text files that are read wrongly, or slowly, by a naive reader."""

import time

import numpy as np
import pytest
from tests.fuzz.seeds import ROAD_NET, ROAD_TRIPS, TANK

import dvax
from dvax.formats import read_at2, read_netlist, read_network, read_trips
from dvax.formats.csv_columns import read_columns


def refusal(read):
    with pytest.raises(dvax.InputError) as caught:
        read()
    return str(caught.value)


def columns(path, content):
    path.write_bytes(content)
    return read_columns(path, ["time", None], "time")


def test_csv_number_in_quotes_over_two_lines_is_no_number(tmp_path):
    """Joined, "1" and "2" on two lines would be 12."""
    said = refusal(lambda: columns(tmp_path / "a.csv", b'time [s],x [1]\n0,"1\n2"\n1,3\n'))
    assert "a finite decimal number" in said and "line 3" in said


def test_csv_lines_end_at_line_ends_alone(tmp_path):
    for end in (b"\n", b"\r\n", b"\r"):
        rows = [b"\xef\xbb\xbftime [s],x [1],note []", "0,1,a\u2028b\x0bc".encode(), b"2,3,d"]
        time_, x, _ = (*columns_of(tmp_path / "a.csv", end.join(rows)), None)
        np.testing.assert_array_equal(time_.values, [0, 2])
        assert x.lines.tolist() == [2, 3]


def columns_of(path, content):
    path.write_bytes(content)
    return read_columns(path, ["time", "x"], "time")


def test_csv_with_a_million_columns_is_refused_at_once(tmp_path):
    start = time.process_time()
    said = refusal(lambda: columns(tmp_path / "a.csv", b"a [1]," * 10**6))
    assert "at most 10000 cells" in said and time.process_time() - start < 1.0


def test_total_of_trips_that_is_a_zero_with_a_large_exponent_is_read(tmp_path):
    path = tmp_path / "a_trips.tntp"
    path.write_text(ROAD_TRIPS.replace("> 6.0", "> 0e999"))
    assert read_trips(path).flow.tolist() == [6.0]


def test_network_of_more_nodes_than_its_links_have_is_refused(tmp_path):
    path = tmp_path / "a_net.tntp"
    path.write_text(ROAD_NET.replace("NODES> 4", "NODES> 999999999"))
    assert "999999999 nodes and 5 links" in refusal(lambda: read_network(path))


def test_long_blanks_in_a_netlist_take_linear_time():
    start = time.process_time()
    assert read_netlist(TANK + "R9 1 0" + " " * 10**5 + "5" + " " * 10**5).of("R")
    assert time.process_time() - start < 1.0


def test_long_description_of_a_record_takes_linear_time(tmp_path):
    path = tmp_path / "a.at2"
    start = time.process_time()
    path.write_text("unit ( " * 50_000 + "\nNPTS= 2, DT= .02 SEC\n0 0\n")
    assert "without the unit" in refusal(lambda: read_at2(path))
    assert time.process_time() - start < 1.0
