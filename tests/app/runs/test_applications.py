"""Configurations of applications: rejected input, and the files that a run writes."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray
from tests.formats.test_rts_gmlc import write as write_rts

import dvax
from dvax.app.plots import build_report
from dvax.app.runs.applications.config import APPLICATIONS, ModelConfig, module_of, read_config
from dvax.app.runs.compile_time import compile_seconds
from dvax.app.runs.driver import run

TANK = """* a tank that a diode damps in one half-wave
C1 1 0 1u IC=10
L1 1 0 10m
D1 1 0 R=1k
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("circuit")
    (where / "tank.cir").write_text(TANK)
    (where / "tank.toml").write_text(
        '[model]\nname = "circuit"\nnetlist = "tank.cir"\nt_end = "1 ms"\nframes = 20\n'
    )
    return where


@pytest.fixture(scope="module")
def outcome(folder):
    return run(read_config(folder / "tank.toml"), folder / "run")


def written(folder, text, name="bad.toml"):
    file = folder / name
    file.write_text(text)
    return file


def problems(file, **options):
    with pytest.raises(dvax.InputError) as caught:
        read_config(file, **options)
    return [str(problem) for problem in caught.value.problems]


def test_unknown_model_error_lists_the_names(folder):
    (told,) = problems(written(folder, '[model]\nname = "circit"\n'))
    assert "model.name" in told and "fem-contact" in told and "Did you mean 'circuit'?" in told


def test_missing_model_name_is_reported(folder):
    (told,) = problems(written(folder, '[model]\nnetlist = "tank.cir"\nt_end = 1.0\n'))
    assert "model.name: got nothing" in told and 'Add name = "circuit"' in told
    assert all(name in told for name in ("contact", *APPLICATIONS))
    # A contact law needs none.
    told = problems(written(folder, "[model]\nalpha = 1.0\nperiod = 2.0\n"))
    assert any("model.period" in line and "no key" in line for line in told)


def test_model_table_errors_are_reported_at_once(folder):
    told = problems(
        written(
            folder,
            '[model]\nname = "circuit"\nnetlists = "tank.cir"\nt_end = "5 V"\nr_on = -1.0\n[bnd]\n',
        )
    )
    for word in ("bnd", "netlists", "Did you mean 'netlist'", "t_end", "r_on", "greater than 0"):
        assert any(word in line for line in told), (word, told)


def test_data_files_must_lie_beside_the_configuration_unless_allowed(folder, tmp_path):
    shutil.copy(folder / "tank.cir", tmp_path / "tank.cir")
    inner = tmp_path / "inner"
    inner.mkdir()
    text = '[model]\nname = "circuit"\nnetlist = "{}"\nt_end = 1e-3\n'
    for name in ("../tank.cir", str(tmp_path / "tank.cir")):
        file = written(inner, text.format(name))
        (told,) = problems(file)
        assert "model.netlist" in told
        assert isinstance(read_config(file, allow_outside=True), ModelConfig)
    (told,) = problems(written(inner, text.format("none.cir")))
    assert "there is no such file" in told
    (told,) = problems(written(inner, '[model]\nname = "market"\ndata = "no"\nstart_hour = 0\n'))
    assert "there is no such folder" in told
    (told,) = problems(written(inner, text.format("C1 1 0 1u\\nR1 1 0 10")))
    assert "this is the text of one" in told


def test_data_errors_name_their_line(folder):
    (folder / "open.cir").write_text("C1 1 0 1u\nL1 1 0 ten\n")
    told = problems(
        written(folder, '[model]\nname = "circuit"\nnetlist = "open.cir"\nt_end = 1.0\n')
    )
    assert any("open.cir, line 2" in line for line in told)


@pytest.mark.slow
def test_application_run_writes_figures_data_and_a_report(folder, outcome):
    assert outcome.exit_code == 0 and outcome.status == "finished"
    summary = json.loads((outcome.directory / "summary.json").read_text())
    assert set(summary["final_C1"]) == {"value", "unit", "meaning"}
    assert [summary[f"final_{name}"]["unit"] for name in ("C1", "L1")] == ["V", "A"]
    bound = summary["error_bound"]["value"]
    assert 0 < bound < 1e-8
    # ‖x‖² = Cv² + Li², with the values of the netlist.
    for name, storage, unit in (("C1", 1e-6, "V"), ("L1", 10e-3, "A")):
        of_state = summary[f"error_bound_{name}"]
        assert of_state["value"] == pytest.approx(bound / storage**0.5)
        assert of_state["unit"] == unit and of_state["bound"] == summary["error_bound"]["bound"]
    manifest = json.loads((outcome.directory / "manifest.json").read_text())
    assert manifest["model"] == "circuit" and manifest["fit"] == "exact"
    assert list(manifest["data"]) == ["tank.cir"]
    assert any(
        row["name"] == "gamma" and row["status"] == "proved" for row in manifest["constants"]
    )
    with xarray.open_zarr(outcome.directory / "trajectory.zarr", consolidated=False) as data:
        assert data.sizes["time"] == 21 and "state_C1" in data
        for name in ("C1", "L1"):
            last = summary[f"final_{name}"]["value"]
            np.testing.assert_allclose(data[f"state_{name}"][-1], last, rtol=1e-12)
        assert data.state_C1.attrs["units"] == "V"
    page = build_report(outcome.directory).read_text()
    assert "model circuit, exact" in page and "The circuit over time" in page
    for picture in ("circuit", "certificate"):
        assert (outcome.directory / "figures" / f"{picture}.png").stat().st_size > 10_000


@pytest.mark.slow
def test_resolved_configuration_gives_the_same_run(outcome, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(outcome.directory, moved)
    again = run(read_config(moved / "config.resolved.toml"), tmp_path / "again")
    assert again.summary == outcome.summary
    # Each run counts the compilations of its own, and not those of the process before it.
    manifests = [json.loads((o.directory / "manifest.json").read_text()) for o in (outcome, again)]
    first, second = (manifest["compile_seconds"] for manifest in manifests)
    assert first > 0 and first + second <= compile_seconds() + 1e-2


def test_application_run_prints_its_stages(outcome):
    lines = (outcome.directory / "log.jsonl").read_text().splitlines()
    stages = [event["stage"] for event in map(json.loads, lines) if event["event"] == "stage"]
    assert stages == ["solving from 0 to 0.001 s", "writing the results"]


def test_run_directory_of_an_unknown_model_is_rejected(outcome, tmp_path):
    for name in ("circit", "data"):
        moved = tmp_path / name
        shutil.copytree(outcome.directory, moved)
        manifest = json.loads((moved / "manifest.json").read_text())
        (moved / "manifest.json").write_text(json.dumps(manifest | {"model": name}))
        with pytest.raises(dvax.InputError) as caught:
            build_report(moved)
        (problem,) = caught.value.problems
        assert "manifest.json" in problem.place and problem.given == repr(name)
        assert all(known in problem.rule for known in APPLICATIONS)


SHARED = Path(__file__).parents[4] / "shared" / "data"
RUNS = {
    "frame": (
        'record = "elCentro.at2"\nperiod = 0.5\ndamping = 0.02\n',
        ("peak_displacement", 2.676, 2e-3),
    ),
    "market": (
        'data = "RTS-GMLC"\nstart_hour = 4380\nhours = 2\n', ("price", [82.34147234], 1e-9),
    ),
    "fem-contact": (
        "fine = 10\ncoarse = 4\nlayers = 17\nindentation = 0.01\nstiffness = 100.0\n"
        "pressure_cap = 0.01\n",
        ("force", 4.67498819e-3, 1e-8),
    ),
    "traffic": (
        'network = "SiouxFalls/SiouxFalls_net.tntp"\ntrips = "SiouxFalls/SiouxFalls_trips.tntp"\n',
        ("objective", 4231335.287107, 1e-9),
    ),
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("name", RUNS)
def test_application_run_gives_the_reference_figures(name, tmp_path):
    lines, (figure, value, relative) = RUNS[name]
    for line in lines.splitlines():
        given = line.split(" = ")[1].strip('"')
        if "/" in given or given in ("elCentro.at2", "RTS-GMLC"):
            if not (SHARED / given).exists():
                pytest.skip(f"needs {given} under ../shared/data")
            (tmp_path / given).parent.mkdir(exist_ok=True)
            copy = shutil.copytree if (SHARED / given).is_dir() else shutil.copy
            copy(SHARED / given, tmp_path / given)
    file = written(tmp_path, f'[model]\nname = "{name}"\n{lines}')
    outcome = run(read_config(file), tmp_path / "run")
    assert outcome.exit_code == 0
    reached = np.atleast_1d(outcome.summary[figure]["value"])[: np.size(value)]
    np.testing.assert_allclose(reached, np.atleast_1d(value), rtol=relative)
    assert build_report(outcome.directory).stat().st_size > 10_000
    again = read_config(outcome.directory / "config.resolved.toml")
    assert isinstance(again, ModelConfig) and again.name == name


@pytest.mark.parametrize("name", APPLICATIONS)
def test_applications_page_lists_every_key_of_a_model(name):
    page = (Path(__file__).parents[3] / "docs" / "applications.md").read_text(encoding="utf-8")
    table = page.split(f"### {name}\n")[1].split("\n### ")[0]
    for key, field in module_of(name).APPLICATION.section.model_fields.items():
        if key != "name":
            known = isinstance(field.default, int | float | str)
            told = "required" if field.is_required() else str(field.default) if known else "–"
            assert f"| `{key}` | {told} |" in table, key


def test_model_that_reads_a_folder_keeps_its_name(tmp_path):
    write_rts(tmp_path)
    file = written(
        tmp_path, '[model]\nname = "market"\ndata = "."\nstart_hour = 0\nhours = 4\n', "market.toml"
    )
    assert read_config(file).name == "market"
