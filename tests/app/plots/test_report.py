"""The report shows the content of the run directory, and nothing else."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from matplotlib.image import imread
from tests.app.plots.page_data import figures_of
from tests.app.plots.synthetic import CONSTANTS, Recipe, write_run
from tests.selection import mostly_thorough

from dvax.app.plots import build_report
from dvax.app.plots.applications import application_pictures
from dvax.app.plots.certificate import certificate_picture
from dvax.app.plots.downsample import downsample
from dvax.app.plots.histories import histories_picture
from dvax.app.plots.page import document, sections
from dvax.app.plots.run_reader import read_run
from dvax.app.plots.separation import separation_picture
from dvax.app.plots.theme import number, unit_text
from dvax.errors import InputError

ALWAYS = {"pressure", "regimes", "shares", "histories", "certificate", "separation"}
PICTURES = ALWAYS | {"pressure-section"}


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the size of the demonstration, with its report."""
    run_dir = write_run(tmp_path_factory.mktemp("large") / "run", Recipe((20_000,), frames=201))
    build_report(run_dir)
    return run_dir


def variable(values: list[float], unit: str) -> Any:
    return SimpleNamespace(values=np.array(values), unit=unit, status="")


def stills(run_dir: Path) -> set[str]:
    return {file.stem for file in (run_dir / "figures").glob("*.png")}


@pytest.mark.slow
def test_report_of_a_large_run_has_at_most_three_megabytes(large: Path) -> None:
    page = large / "report.html"
    assert page.stat().st_size <= 3e6
    assert "a cell gathers up to 56 points and 1 frame." in page.read_text(encoding="utf-8")


@pytest.mark.thorough
def test_report_pictures_have_nonblank_png_files(large: Path) -> None:
    assert stills(large) == PICTURES
    for file in (large / "figures").glob("*.png"):
        pixels = imread(file)
        assert min(pixels.shape[:2]) > 400
        assert pixels[..., :3].std() > 0.05, f"{file.name} is blank"


@pytest.mark.slow
def test_report_lists_every_constant_with_its_label(large: Path) -> None:
    text = (large / "report.html").read_text(encoding="utf-8")
    for name, _, _, _, label, _ in CONSTANTS:
        assert f"<code>{name}</code>" in text
        assert f"<code>{label}</code>" in text


@pytest.mark.slow
def test_report_makes_no_network_request(large: Path) -> None:
    text = (large / "report.html").read_text(encoding="utf-8")
    outside_scripts = "".join(part.split("</script>")[-1] for part in text.split("<script"))
    for fetching in ("http://", "https://", "@import", "url(", "<iframe", "src="):
        assert fetching not in outside_scripts


def test_report_of_a_finished_run_has_no_banner(large: Path) -> None:
    assert "Partial results." not in (large / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("status", ["interrupted", "failed", "running"])
def test_report_of_a_stopped_run_begins_with_its_status(tmp_path: Path, status: str) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,), frames=21, written=11, status=status))
    text = build_report(run_dir, stills=False).read_text(encoding="utf-8")
    banner, pictures = text.index("Partial results."), text.index('<section class="lead"')
    assert banner < pictures
    assert "It holds 11 frames, up to t = 20 s of 40 s." in text
    # A run that was killed has no reason to give.
    assert ("Stopped by Ctrl-C." in text[:pictures]) == (status != "running")
    assert "from 0 to 20 (of 40) s" in text


@pytest.mark.slow
@pytest.mark.parametrize("written", mostly_thorough([1, 2], [1]))
def test_report_of_few_frames_has_pictures(tmp_path: Path, written: int) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,), written=written, status="failed"))
    build_report(run_dir)
    assert stills(run_dir) == PICTURES


def test_report_without_frames_has_no_pictures(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,), written=0, status="failed"))
    text = build_report(run_dir).read_text(encoding="utf-8")
    assert "the run wrote no results" in text
    assert 'class="plot"' not in text
    assert stills(run_dir) == set()


@pytest.mark.thorough
def test_report_of_a_surface_has_maps_with_a_slider(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40, 25), frames=30))
    text = build_report(run_dir).read_text(encoding="utf-8")
    assert stills(run_dir) == ALWAYS
    assert text.count('type="range"') == 2
    assert "24 of 30 saved frames are drawn." in text


@pytest.mark.slow
def test_report_without_companion_explains_the_missing_picture(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,), companion=False))
    text = build_report(run_dir).read_text(encoding="utf-8")
    assert "Certified decay: the run had no companion trajectory." in text
    assert stills(run_dir) == PICTURES - {"separation"}


EVIL = "</script><img src=x onerror=alert(1)>"


def test_report_escapes_text_of_the_run(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,), title=EVIL))
    manifest = json.loads((run_dir / "manifest.json").read_text())
    evil = {"device": EVIL, "method": EVIL, "data": {EVIL: {"sha256": EVIL, "bytes": 1}}}
    (run_dir / "manifest.json").write_text(json.dumps(manifest | evil))
    config = (run_dir / "config.resolved.toml").read_text()
    (run_dir / "config.resolved.toml").write_text(f"# {EVIL}\n{config}")
    summary = {EVIL: {"value": EVIL, "unit": EVIL, "meaning": EVIL}}
    (run_dir / "summary.json").write_text(json.dumps(summary))
    text = build_report(run_dir, stills=False).read_text(encoding="utf-8")
    assert text.count("onerror=alert(1)&gt;") >= 9
    assert "<img" not in text and "</script><" not in text


def test_report_has_no_readable_data_of_a_figure(tmp_path: Path) -> None:
    """Names and units inside figures cannot close the element that holds them: it is base64."""
    data = {
        "time": variable([0.0, 1.0], "s"),
        EVIL: variable([0.0, 1.0], EVIL),
    }
    (picture,) = application_pictures("python", data)
    text = document(EVIL, EVIL, "", sections([picture]), [picture])
    assert "<img" not in text
    block = text.split('<script type="text/plain" id="data">')[1].split("</script>")[0]
    assert re.fullmatch(r"[A-Za-z0-9+/=]+", block)
    assert EVIL in figures_of(text)["histories"]["figure"]["layout"]["yaxis"]["title"]["text"]


def test_a_bound_without_a_finite_value_has_no_picture():
    inf = float("inf")
    for values, words in (
        ([1e-9, 1e-8, 1e-7], ""),
        ([1e-9, 1e-8, inf], "From time = 2 s on it states nothing."),
        ([0.0, inf, inf], None),
    ):
        data = {"time": variable([0.0, 1.0, 2.0], "s"), "x": variable([0.0, 1.0, 2.0], "m")}
        bound = {"values": np.array(values), "unit": "m", "status": "proved"}
        data["error_bound"] = SimpleNamespace(**bound, dims=("time",), attrs={})
        found = application_pictures("python", data)
        assert len(found) == (1 if words is None else 2)
        if words is not None:
            assert found[-1].key == "certificate" and found[-1].caption.endswith(words)


def test_report_describes_every_figure_in_words(large: Path) -> None:
    text = (large / "report.html").read_text(encoding="utf-8")
    described = re.findall(r'class="plot"[^>]*role="img"\s+aria-label="([^"]+)"', text)
    assert len(described) == len(PICTURES) == text.count('class="plot"')
    assert all(len(words) > 60 and words.endswith(".") for words in described), described


def test_report_is_the_same_each_time(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,), frames=5))
    first, again = (build_report(run_dir, stills=False).read_bytes() for _ in range(2))
    assert first == again


def test_report_folds_its_tables_and_links_to_every_part(large: Path) -> None:
    text = (large / "report.html").read_text(encoding="utf-8")
    folded = re.findall(r'<details id="([^"]*)"><summary>([^<]*)', text)
    assert [title.strip() for _, title in folded] == [*("Constants", "Configuration", "Provenance")]
    assert "<details open" not in text
    links = re.findall(r'<a href="#([^"]*)">', text)
    assert links == re.findall(r'<(?:section|details) id="([^"]*)"', text)
    assert set(links) >= {f"about-{key}" for key in PICTURES}


def test_report_draws_sections_of_the_map_that_holds_their_data(large: Path) -> None:
    drawn = figures_of((large / "report.html").read_text(encoding="utf-8"))
    frames = drawn["pressure-section"]["about"]["frames"]
    assert [change["section"] for change in frames["changes"]] == [["pressure", 0]]
    maps = drawn["pressure"]["figure"]["data"]
    rows, columns = map(int, maps[0]["z"]["shape"].split(","))
    assert len(frames["labels"]) == columns
    assert len(drawn["pressure-section"]["figure"]["data"]) == 1 and rows == 360
    assert drawn["pressure"]["about"]["zoom"] == drawn["histories"]["about"]["zoom"] == "time [s]"


def test_report_omits_and_counts_frames_without_a_valid_time(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,), frames=20))
    store = run_dir / "trajectory.zarr"
    data = xr.open_zarr(store, consolidated=False, chunks=None).load()
    time = data.time.values.copy()
    time[15:] = np.nan
    broken = data.assign_coords(time=("time", time, data.time.attrs)).drop_encoding()
    broken.to_zarr(store, mode="w", consolidated=False)
    run = read_run(run_dir)
    assert len(run.time) == 15
    assert run.notes[0].startswith("5 of 20 frames have no valid time")
    assert "5 of 20 frames" in build_report(run_dir, stills=False).read_text(encoding="utf-8")


def test_report_reads_a_truncated_log(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,)))
    with (run_dir / "log.jsonl").open("a") as log:
        log.write('{"event": "warni')
    assert read_run(run_dir).warnings == ("A point was snapped to s = 0.25 mm.",)


@pytest.mark.parametrize("file", ["manifest.json", "summary.json", "config.resolved.toml"])
def test_report_names_a_damaged_file(tmp_path: Path, file: str) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,)))
    (run_dir / file).write_text("{ this is not it")
    with pytest.raises(InputError, match=file.replace(".", r"\.")):
        build_report(run_dir)
    assert not (run_dir / "report.html").exists()


def test_report_rejects_a_folder_that_is_no_run_directory(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"manifest\.json"):
        build_report(tmp_path)


def test_report_certificate_legend_shows_its_status(tmp_path: Path) -> None:
    picture = certificate_picture(read_run(write_run(tmp_path / "run", Recipe((40,)))))
    assert picture is not None
    names = [trace.name for trace in picture.interactive.data]
    assert names[:4] == [
        "bound on the error of x (proved)",
        "bound on the error of u (declared)",
        "the same for x, one-sided rate (proved)",
        "error of the frozen law, u (proved)",
    ]
    assert picture.interactive.layout.yaxis.type == "log"
    # The bound of x is zero at t = 0: a gap on this axis, and the caption says so.
    assert np.isnan(picture.interactive.data[0].y[0])
    assert "left as a gap" in picture.caption


def test_report_separation_shows_observed_certified_and_sharp(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path / "run", Recipe((40,))))
    picture = separation_picture(run)
    assert picture is not None
    drawn = {trace.name: trace for trace in picture.interactive.data if trace.yaxis == "y"}
    assert list(drawn) == ["observed", "certified, e^(−(η−ML̃)t)", "sharper, one-sided rate"]
    np.testing.assert_allclose(drawn["observed"].y, run.series("separation_x"))
    assert "separation of x is 1." in picture.caption
    # e^(−1.1·40) is far below what double precision can tell apart, and the caption says so.
    assert "floating-point rounding, which no bound covers" in picture.caption


def test_report_histories_are_those_of_the_requested_points(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,)))
    config = "[time]\nend = 40.0\n[output]\npoints_of_interest = [10.1, 80.0]\n"
    (run_dir / "config.resolved.toml").write_text(config)
    run = read_run(run_dir)
    picture = histories_picture(run, downsample(run))
    place = run.series("s")
    for wanted in (10.1, 80.0):
        point = int(np.abs(place - wanted).argmin())
        name = f"s = {number(float(place[point]), 6)} mm"
        drawn = [trace for trace in picture.interactive.data if trace.name == name]
        assert len(drawn) == 2, "pressure and indentation"
        np.testing.assert_array_equal(drawn[0].y, run["pressure"].values[:, point])
        np.testing.assert_array_equal(drawn[1].y, run["indentation"].values[:, point])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (4.0, "4"),
        (1.23456e-7, "1.235 × 10⁻⁷"),
        (123456.0, "123456"),
        (4000, "4\u202f000"),
    ],
)
def test_report_number_format(value: float, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        ("um", "µm"),
        ("um/s", "µm/s"),
        ("1", ""),
        ("um*mm**0.5", "µm mm⁰·⁵"),
        ("um mm^(1/2)", "µm mm⁰·⁵"),
        ("dimensionless", ""),
    ],
)
def test_report_unit_format(unit: str, text: str) -> None:
    assert unit_text(unit) == text
