"""Netlists: accepted lines, and errors with line, rule and fix."""

import numpy as np
import pytest

import dvax
from dvax.formats import read_netlist
from dvax.formats.netlist_values import read_value
from dvax.models.circuit import Circuit

TANK = "C1 1 0 1u IC=10\nL1 1 0 10m\nD1 1 0 R=1k\n"


@pytest.mark.parametrize(
    ("text", "quantity", "value"),
    [
        ("1", "resistance", 1.0), ("4.7k", "resistance", 4700.0), ("2Meg", "resistance", 2e6),
        ("1kohm", "resistance", 1e3), ("3MEGΩ", "resistance", 3e6), ("1m", "inductance", 1e-3),
        ("10mH", "inductance", 1e-2), ("2.2uF", "capacitance", 2.2e-6), ("5µF", "capacitance", 5e-6),
        ("100pF", "capacitance", 1e-10), ("3fF", "capacitance", 3e-15), ("-1.5e-3", "voltage", -1.5e-3),
        (".5mV", "voltage", 5e-4), ("1e3", "resistance", 1e3), ("2g", "resistance", 2e9),
        ("1T", "resistance", 1e12), ("1kHz", "frequency", 1e3), ("90deg", "angle", 90.0),
        ("3nS", "conductance", 3e-9), ("7ms", "time", 7e-3), ("+2A", "current", 2.0),
    ],
)  # fmt: skip
def test_netlist_numbers_have_suffixes_and_units(text, quantity, value):
    assert read_value(text, quantity, "here") == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "quantity", "said"),
    [
        ("10M", "resistance", "M is milli in SPICE and mega everywhere else"),
        ("1MHz", "frequency", "M is milli in SPICE and mega everywhere else"),
        ("2Mohm", "resistance", "M is milli in SPICE and mega everywhere else"),
        ("1F", "capacitance", "F alone is femto in SPICE and farad everywhere else"),
        ("10mH", "capacitance", "the capacitance is in F, and this has a unit of inductance"),
        ("1kV", "current", "the current is in A, and this has a unit of voltage"),
        ("5 parsec", "resistance", "a decimal number"),
        ("1,5", "resistance", "a decimal number"),
        ("nan", "resistance", "a decimal number"),
        ("1e999", "resistance", "values are finite"),
        ("3xyz", "resistance", "in no unit that is known"),
    ],
)
def test_netlist_rejects_invalid_numbers(text, quantity, said):
    with pytest.raises(dvax.InputError) as caught:
        read_value(text, quantity, "a.net, line 3")
    (problem,) = caught.value.problems
    assert said in problem.rule and problem.place == "a.net, line 3" and text in problem.given


REFUSED = {
    "unknown element": ("Q1 a b c", "line 4", "elements begin with R, L, C, V, I or D"),
    "a command": (".tran 1u 1m", "line 4", "there are no commands"),
    "missing node": ("R1 1", "line 4", "a node is missing"),
    "missing value": ("R1 1 0", "line 4", "its value is missing"),
    "one node alone": ("D2", "line 4", "a node is missing"),
    "wrong unit": (
        "R1 1 0 1uF",
        "line 4",
        "the resistance is in ohm, and this has a unit of capacitance",
    ),
    "wrong unit of an initial value": ("C2 1 2 1u IC=1A", "line 4", "the voltage is in V"),
    "negative": ("R1 1 0 -5", "line 4", "the resistance is positive"),
    "zero": ("C2 1 0 0", "line 4", "the capacitance is positive"),
    "duplicate": ("c1 1 0 5u", "line 4", "line 1 has this name already"),
    "both ends": ("R1 1 1 5", "line 4", "both ends are one node"),
    "word": ("R1 1 0 5 IC=3", "line 4", "the words of an element R are none"),
    "word of a diode": ("D2 1 0 N=2", "line 4", "the words of an element D are R= and G="),
    "model of a diode": ("D2 1 0 1N4148", "line 4", "no models of diodes are known"),
    "two values": ("L2 1 0 5m 6m", "line 4", "two nodes and one value"),
    "waveform": ("V1 1 0 EXP(0 1 2)", "line 4", "a waveform is one of SIN, PWL, PULSE"),
    "open bracket": ("V1 1 0 SIN(0 1 2", "line 4", "a source is a number"),
    "short sine": ("V1 1 0 SIN(0 1)", "line 4", "an offset, an amplitude and a frequency"),
    "sine before its time": ("V1 1 0 SIN(0 1 50 -1)", "line 4", "the delay is not negative"),
    "odd lines": ("V1 1 0 PWL(0 1 2)", "line 4", "pairs of a time and a value"),
    "late lines": ("V1 1 0 PWL(1m 1 2m 2)", "line 4", "begin at 0"),
    "lines back in time": ("V1 1 0 PWL(0 1 2m 2 1m 3)", "line 4", "and increase"),
    "dangling node": ("R1 1 2 5", "line 4", "only R1 is connected to it"),
    "island": ("R1 2 3 5\nR2 2 3 5", "line 4", "they are not connected to node 0"),
    "capacitor loop": ("C2 1 0 1u", "line 4", "form a loop"),
    "capacitors and a source": ("C2 1 2 1u\nV1 2 0 5", "line 5", "form a loop"),
    "cut of inductors": ("L2 1 2 1m\nL3 2 0 1m", "lines 4 and 5", "inductors and current sources"),
    "cut of a diode": ("L2 1 2 1m\nD2 2 0 R=1", "line 5", "no modulus γ > 0"),
    "word twice": ("C2 1 2 1u IC=10 ic=5\nR1 2 0 1", "line 4", "a word stands once"),
    "no resistance": ("D2 1 0", "line 4", "its current meets no resistance"),
    "two in parallel": ("R1 1 2 5\nD2 2 0\nD3 2 0", "lines 5 and 6", "some combination"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_netlist_errors_name_their_line(name):
    added, line, said = REFUSED[name]
    with pytest.raises(dvax.InputError) as caught:
        Circuit(TANK + added)
    (problem,) = caught.value.problems
    assert problem.place == f"netlist, {line}"
    assert said in problem.rule
    assert problem.fix and problem.given


def test_netlist_error_for_diodes_without_resistance_suggests_regularisation():
    text = TANK.replace(" R=1k", "")
    with pytest.raises(dvax.InputError) as caught:
        Circuit(text)
    (problem,) = caught.value.problems
    assert "D1 without R=" in problem.given and "γ = λ_min(D) = 0" in problem.rule
    assert "r_on = 0.1" in problem.fix
    circuit = Circuit(text, r_on=0.1)
    assert circuit.fit == "regularised by r_on = 0.1 Ω: ideal diodes in the limit 0"
    assert float(circuit.constants.gamma) == pytest.approx(0.1)
    # What the line says is not written over.
    assert Circuit(TANK, r_on=0.1).fit == "exact"


def test_netlist_error_for_duplicate_keywords_shows_both():
    with pytest.raises(dvax.InputError) as caught:
        read_netlist("C1 1 0 1u IC=10 IC=5\nD1 1 0 R=1k R=2k", "x")
    said = [(problem.place, problem.given) for problem in caught.value.problems]
    assert said == [("x, line 1", "IC=10 and IC=5"), ("x, line 2", "R=1k and R=2k")]


def test_netlist_source_shorter_than_the_run_names_its_line():
    circuit = Circuit(TANK + "R1 1 2 1k\nV1 2 0 PWL(0 0 1m 5)\nI1 0 1 PWL(0 0 9m 1)")
    circuit.check_sources(1e-3)
    for ask in (circuit.check_sources, circuit.solve):
        with pytest.raises(dvax.InputError) as caught:
            ask(5e-3)
        (problem,) = caught.value.problems
        assert problem.place == "netlist, line 5"
        assert (
            problem.given == "V1, which is defined from 0 to 0.001 s"
            and "t_end = 0.005 s" in problem.rule
        )
        assert "t_end = 0.001" in problem.fix


def test_netlist_errors_of_the_whole_circuit_are_reported_at_once():
    with pytest.raises(dvax.InputError) as caught:
        Circuit("R1 a b 5\nR2 a b 6")
    given = [problem.given for problem in caught.value.problems]
    assert given == ["no node 0", "no capacitor and no inductor", "no diode"]


def test_netlist_reports_all_invalid_lines_at_once():
    with pytest.raises(dvax.InputError) as caught:
        Circuit("X1 a 0 5\nR1 a 0 -1\n\n* fine\nC1 a\nC1 a 0 1u\n")
    places = [problem.place for problem in caught.value.problems]
    assert places == [f"netlist, line {k}" for k in (1, 2, 5, 6)]


@pytest.mark.parametrize("value", [0.0, -1.0, np.inf, np.nan])
def test_circuit_rejects_regularisation_options_without_effect(value):
    with pytest.raises(dvax.InputError) as caught:
        Circuit(TANK, r_on=value, g_leak=value)
    assert [p.place.split("(")[1] for p in caught.value.problems] == ["r_on)", "g_leak)"]


def test_netlist_errors_name_the_file(tmp_path):
    good, bad, binary = (tmp_path / name for name in ("good.net", "bad.net", "binary.net"))
    good.write_text("# Siconos's CircuitRLCD\n" + TANK + ".end\n", encoding="utf-8")
    bad.write_text(TANK + "R1 1 0 5H\n", encoding="utf-8")
    binary.write_bytes(b"R1 1 0 \xff\n")
    assert Circuit.from_file(good).states == ("C1", "L1")
    for path, place in ((bad, "bad.net, line 4"), (binary, "binary.net")):
        with pytest.raises(dvax.InputError) as caught:
            Circuit.from_file(path)
        assert caught.value.problems[0].place == place
    with pytest.raises(FileNotFoundError):
        Circuit.from_file(tmp_path / "none.net")


def test_netlist_lines_are_parsed_exactly():
    net = read_netlist(
        "l1 a 0 1m ic = 2 ; first\nV1 b 0 dc 5V\nV2 c 0 sin( 0, 1, 50 )\nD1 a b", "x"
    )
    kinds = [(e.kind, e.name, e.a, e.b, e.line) for e in net.elements]
    assert kinds == [
        ("L", "l1", "a", "0", 1), ("V", "V1", "b", "0", 2), ("V", "V2", "c", "0", 3),
        ("D", "D1", "a", "b", 4),
    ]  # fmt: skip
    inductor, dc, sine, diode = net.elements
    assert (inductor.value, inductor.initial) == (1e-3, 2.0)
    assert dc.source is not None and sine.source is not None
    assert float(dc.source(0.3)) == 5.0 and float(sine.source(5e-3)) == pytest.approx(1.0)
    assert diode.series is None and diode.leak is None
