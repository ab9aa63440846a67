"""Applications from the command line: rejected input with the keys of the file, notes, and the messages
of failed runs."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from tests.models.traffic_networks import braess
from typer.testing import CliRunner

import dvax
from dvax.app.cli.program import app
from dvax.app.runs.applications.models.circuit import CircuitApplication

CIRCUIT = '[model]\nname = "circuit"\nnetlist = "a.cir"\nt_end = "5 ms"\n'
FRAME = '[model]\nname = "frame"\nrecord = "a.at2"\nperiod = 0.5\ndamping = 0.05\n'
ROADS = '[model]\nname = "traffic"\nnetwork = "braess_net.tntp"\ntrips = "braess_trips.tntp"\n'
BODY = '[model]\nname = "fem-contact"\nfine = 2\ncoarse = 2\nlayers = 2\n'
INCIDENT = (
    "[[model.incidents]]\ninit_node = 1\nterm_node = 3\nremaining = 0.5\nstart = 1.0\nend = 2.0\n"
)
TANK = "C1 1 0 1u IC=10\nL1 1 0 10m\nD1 1 0 R=1k\n"
RECORD = "A record\nof no place\nThe units are (g)\nNPTS= 4, DT= .02 SEC\n 0.0 0.1 -0.1 0.0\n"


def write(folder: Path, text: str, netlist: str = TANK) -> Path:
    braess(folder)
    (folder / "a.cir").write_text(netlist)
    (folder / "a.at2").write_text(RECORD)
    (folder / "a.msh").write_text("no mesh")
    config = folder / "a.toml"
    config.write_text(text)
    return config


# name: (the configuration, its netlist, and of each problem: place, and what is said of it)
REFUSED: dict[str, tuple[str, str, dict[str, tuple[str, ...]]]] = {
    "short source": (
        CIRCUIT, TANK + "R1 1 2 1k\nV1 2 0 PWL(0 0 1m 5)\n",
        {"a.cir, line 5": ("V1, which is defined from 0 to 0.001 s", "t_end = 0.001")},
    ),
    "word twice": (CIRCUIT, "C1 1 0 1u IC=1 IC=2\n", {"a.cir, line 1": ("IC=1 and IC=2",)}),
    "nothing in time": (
        CIRCUIT, "R1 a 0 5\nD1 a 0 R=1\n",
        {"a.cir": ("no capacitor and no inductor", "Add one, such as C1 a 0 1u")},
    ),
    "no resistance": (
        CIRCUIT, TANK.replace(" R=1k", ""), {"a.cir, line 3": ("r_on = 0.1 and g_leak = 1e-9",)},
    ),
    "units": (
        CIRCUIT + 'r_on = "100 mV"\ng_leak = "3 V"\n', TANK,
        {
            "a.toml: model.r_on": ("it is a number in ohm", 'Write "2.5 ohm".'),
            "a.toml: model.g_leak": ("it is a number in siemens", 'Write "2.5 siemens".'),
        },
    ),
    "no flow": (
        FRAME + "yield_ratio = 0.5\n", TANK,
        {"a.toml: model.viscosity_ratio": ("given: nothing", "viscosity_ratio = 0.01")},
    ),
    "flow alone": (
        FRAME + 'viscosity_ratio = "10 ms"\n', TANK,
        {"a.toml: model.viscosity_ratio": ("given: 0.01", "is elastic", "Omit it")},
    ),
    "points of interest": (
        FRAME + "[output]\npoints_of_interest = [1.0]\n", TANK,
        {"a.toml: output.points_of_interest": ("no key", "Allowed here: report, png")},
    ),
    "quoted numbers": (
        FRAME.replace("0.05", '"5 %"').replace("0.5", '"0.5"'), TANK,
        {
            "a.toml: model.period": ('Write "0.5 s"',),
            "a.toml: model.damping": ("or a unit: damping = 0.05",),
        },
    ),
    "days": (
        ROADS + 'days = "12 h"\nrate = "2"\n', TANK,
        {"a.toml: model.rate": ("rate = 2  # 1/day",), "a.toml: model.days": ("days = 0.5  # day",)},
    ),
    "steps": (ROADS + "dt = 50.0\n", TANK, {"a.toml: model.dt": ("which has 40 days",)}),
    "many steps": (ROADS + "dt = 1e-12\n", TANK, {"a.toml: model.dt": ("cannot be counted",)}),
    "one table": (
        ROADS + INCIDENT.replace("[[", "[").replace("]]", "]"), TANK,
        {"a.toml: model.incidents": ("Write [[model.incidents]]", "remaining = 0.3, start = 5.0")},
    ),
    "a number": (
        ROADS + "incidents = 3\n", TANK, {"a.toml: model.incidents": ("Write [[model.incidents]]",)},
    ),
    "keys of an incident": (
        ROADS + INCIDENT + INCIDENT.replace("remaining = 0.5\nstart = 1.0", 'start = "1 d"'), TANK,
        {
            "a.toml: model.incidents[2].remaining": ("part of its capacity", "Add remaining = 0.3"),
            "a.toml: model.incidents[2].start": ("start = 1  # day",),
        },
    ),
    "hardly anything left": (
        ROADS + INCIDENT.replace("0.5", "1e-9"), TANK,
        {"a.toml: model.incidents[1].remaining": ("0.01 to 1", "Write 0.01 or more")},
    ),
    "hardly anything left of two": (
        ROADS + 2 * INCIDENT.replace("0.5", "0.05"), TANK,
        {"a.toml: model.incidents": ("0.0025 of a capacity", "multiply", "Write 0.01 or more")},
    ),
    "no such link": (
        ROADS + INCIDENT + INCIDENT.replace("node = 3", "node = 2"), TANK,
        {
            "a.toml: model.incidents[2].init_node, model.incidents[2].term_node": (
                "the link from 1 to 2: no such link in braess_net.tntp", "Links from 1 go to 3, 4",
            )
        },
    ),
    "no duration": (
        ROADS + INCIDENT.replace("1.0", "2.0"), TANK,
        {"a.toml: model.incidents[1].start, model.incidents[1].end": ("start < end must hold",)},
    ),
}  # fmt: skip
NEED_FEM = {
    "sizes": (
        BODY + "fine_half_width = 40.0\n", {"a.toml: model.fine_half_width": ("half of the width",)},
    ),
    "too many layers": (
        BODY.replace("layers = 2", "layers = 300"),
        {"a.toml: model.layers, model.growth": ("roundoff dominates the area", "Use fewer layers or")},
    ),
    "a mesh and sizes": (
        BODY + 'mesh = "a.msh"\n',
        {"a.toml: model.mesh, model.fine, model.coarse, model.layers": ("not both", "Keep mesh")},
    ),
    "a name without a mesh": (
        BODY + 'contact = "top"\n', {"a.toml: model.contact": ("'top'", "there is no mesh")},
    ),
    "through the body": (
        BODY + "indentation = 100.0\n",
        {"a.toml: model.indentation": ("the body is 4 high", "check the unit")},
    ),
}  # fmt: skip


def refused(config: Path, expected: dict[str, tuple[str, ...]]) -> None:
    """Assert that `check` and `run` both report each error once at its place, and write nothing."""
    for command in (["check", str(config)], ["run", str(config), "-o", str(config.parent / "out")]):
        result = CliRunner().invoke(app, command)
        assert (result.exit_code, result.stdout) == (2, ""), result.output
        found = re.split(r"(?m)^\d+\. ", result.stderr)[1:]
        assert [block.splitlines()[0] for block in found] == list(expected), result.stderr
        for block, words in zip(found, expected.values(), strict=True):
            for word in words:
                assert word in block
        assert "dvax.models" not in result.stderr and "Circuit(" not in result.stderr
    assert not (config.parent / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", REFUSED)
def test_application_errors_name_keys_of_the_file(name: str, tmp_path: Path) -> None:
    text, netlist, expected = REFUSED[name]
    refused(write(tmp_path, text, netlist), expected)


@pytest.mark.parametrize("name", NEED_FEM)
def test_fem_contact_errors_name_keys_of_the_file(name: str, tmp_path: Path) -> None:
    pytest.importorskip("skfem")
    text, expected = NEED_FEM[name]
    refused(write(tmp_path, text), expected)


NOTED = {
    "an incident after the run": (
        ROADS + "days = 40.0\n" + INCIDENT + INCIDENT.replace("2.0", "60.0").replace("1.0", "50.0"),
        ("model.incidents[2] lasts from day 50 to day 60, and the run, from day 0 to day 40, never",),
    ),
    "a period between samples": (
        FRAME.replace("0.5", "1e-9"), ("model.period is 1e-09 s and samples of the record are 0.02 s",),
    ),
    "large displacements and a short run": (
        BODY + "indentation = 1.2\nend = 1.0\n",
        (
            "model.indentation is 30% of the height of the body, 4",
            "model.indentation is 12% of the radius of the punch, 10",
            "The run ends at 1 while the punch is still pressed in, until model.ramp = 2",
        ),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NOTED)
def test_check_notes_unusual_input(name: str, tmp_path: Path) -> None:
    text, notes = NOTED[name]
    if "fem-contact" in text:
        pytest.importorskip("skfem")
    result = CliRunner().invoke(app, ["check", str(write(tmp_path, text))])
    assert result.exit_code == 0, result.output
    said = [line for line in result.stderr.splitlines() if line.startswith("note: ")]
    assert len(said) == len(notes)
    for line, note in zip(said, notes, strict=True):
        assert line.startswith(f"note: {note}")


SOLVE_ERROR = dvax.SolveError("f returned NaN at t = 3.2, component 17.")
INPUT_ERROR = dvax.InputError(
    dvax.errors.InputProblem(
        "dvax.solve(rtol)", "1e-20", "it is more than rounding", "Ask for less"
    )
)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (SOLVE_ERROR, 3, "failed: f returned NaN at t = 3.2, component 17."),
        (INPUT_ERROR, 2, "failed: a.toml: model.rtol: got 1e-20; it is more than rounding."),
        (KeyboardInterrupt(), 130, "interrupted: Interrupted before there were results."),
    ],
)
def test_failed_run_without_results_reports_none(
    error: BaseException, code: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def solve(*_: Any) -> None:
        raise error

    monkeypatch.setattr(CircuitApplication, "plan", solve)
    config = write(tmp_path, CIRCUIT + "[output]\npng = false\n")
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["run", str(config), "-o", str(out)])
    assert result.exit_code == code, result.output
    assert said in result.stderr and "Traceback" not in result.output
    assert f"the settings and the log are in {out}" in result.stderr
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "<b>No results.</b>" in page and "Partial results" not in page
    assert "what was computed" not in result.stderr and "nothing was written" not in result.stderr
    assert json.loads((out / "manifest.json").read_text())["status"] != "finished"
    assert not (out / "trajectory.zarr").exists()


def test_resistance_of_a_circuit_takes_its_unit() -> None:
    from dvax.app.runs.applications.models.circuit import CircuitSection

    given = {"name": "circuit", "netlist": "a.cir", "t_end": "5 ms", "r_on": "100 mohm"}
    table = CircuitSection.model_validate(given)
    assert (table.r_on, table.g_leak, table.t_end) == (0.1, None, 0.005)


FLOOR = """
[model]
name = "thermostat"
outdoor = "w.csv"
gains = "w.csv"
set_point = 20.0
lengths = [4.0, 4.0]
cells = [4, 4]
diffusivity = "3 m^2/h"
power_max = "200 W/m^2"
t_end = "2 h"

[[model.heaters]]
x = [0.0, 1.0]
y = [0.0, 1.0]
"""


@pytest.mark.parametrize(
    ("header", "rule", "fix"),
    [
        (
            "time [h],outdoor [degF],gains [W/m^2]",
            "it is in degC, and nothing is converted",
            "degC",
        ),
        ("time [h],outdoor [K],gains [W/m^2]", "it is in degC, and nothing is converted", "degC"),
        ("time [h],outdoor [°C],gains [W/m^2]", "it is in degC, and '°C' is not a unit", "degC"),
        ("time [h],temp [degC],gains [W/m^2]", "exactly one besides 'time'", '"outdoor [degC]"'),
        (
            "time [min],outdoor [degC],gains [W/m^2]",
            "(time [min] in the first row)",
            "correct the unit",
        ),
    ],
)
def test_units_and_columns_of_a_file_are_named_with_those_that_are_meant(
    tmp_path, header, rule, fix
):
    config = tmp_path / "a.toml"
    config.write_text(FLOOR)
    (tmp_path / "w.csv").write_text(f"{header}\n0,1.0,0.0\n3,2.0,0.0\n")
    said = CliRunner().invoke(app, ["check", str(config)])
    assert said.exit_code == 2
    assert rule in said.stderr and fix in said.stderr and said.stderr.count("given:") == 1


@pytest.mark.parametrize("name", ["modle", "Model", "modell"])
def test_a_misspelt_table_of_the_model_is_named(tmp_path, name):
    config = tmp_path / "a.toml"
    config.write_text(f'[{name}]\nname = "python"\npython = "a.py"\n[model.parameters]\na = 1\n')
    said = CliRunner().invoke(app, ["check", str(config)])
    assert said.exit_code == 2 and "Did you mean [model]?" in said.stderr and name in said.stderr
