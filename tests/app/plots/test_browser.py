"""The report in a browser: no console error, no request, and every control does what it says."""

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from tests.app.browser import CHROMIUM, Tab, browser
from tests.app.plots.synthetic import CONSTANTS, Recipe, write_run

from dvax.app.plots import build_report
from dvax.app.plots.applications import application_pictures
from dvax.app.plots.page import document, sections
from dvax.app.plots.picture import Views
from dvax.app.plots.theme import DARK, REGIME_COLOURS

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine (Debian: apt-get install chromium)"
)

FIGURES = {
    *("pressure", "pressure-section", "regimes", "shares", "histories", "certificate", "separation")
}
DESKTOP, PHONE = 1280, 390


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with browser(tmp_path_factory.mktemp("profile")) as tab:
        yield tab


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_dir = write_run(tmp_path_factory.mktemp("curve") / "run", Recipe((800,), frames=100))
    return build_report(run_dir, stills=False)


@pytest.fixture
def desktop(tab: Tab, page: Path) -> Tab:
    """The page on a desk; tests share one, and each uses other controls."""
    if tab.shown != (page, DESKTOP, "light"):
        tab.open(page, DESKTOP)
    return tab


def range_of(tab: Tab, key: str) -> list[float]:
    return tab.run(f"Array.from(document.getElementById('{key}')._fullLayout.xaxis.range)")


def click(tab: Tab, selector: str) -> None:
    tab.run(f"document.querySelector({selector!r}).click()")


def overflow(tab: Tab) -> int:
    return tab.run("document.documentElement.scrollWidth - window.innerWidth")


def assert_quiet(tab: Tab) -> None:
    # Software rendering in place of a graphics card is named in the console.
    assert [text for text in tab.errors if "WebGL" not in text] == []
    assert tab.requests == []


def test_page_draws_every_figure_without_a_console_error_or_a_request(desktop: Tab) -> None:
    drawn = desktop.run(
        "Object.fromEntries(Array.from(document.querySelectorAll('.plot'),"
        " (p) => [p.id, p.querySelectorAll('.main-svg').length]))"
    )
    assert set(drawn) == FIGURES and min(drawn.values()) >= 1
    assert overflow(desktop) <= 0
    assert_quiet(desktop)


def test_tables_are_folded_and_unfold(desktop: Tab) -> None:
    shown = "document.querySelector('#about-constants-table table').checkVisibility()"
    assert not desktop.run(shown)
    click(desktop, "#about-constants-table summary")
    assert desktop.run(shown)


def test_slider_moves_the_profile_and_the_line_in_the_map(desktop: Tab) -> None:
    profile = "Array.from(document.getElementById('pressure-section').data[0].y)"
    line = "document.getElementById('pressure').layout.shapes[0].x0"
    column = "Array.from(report.figures.get('pressure').data[0].z, (row) => row[20])"
    said = "document.querySelector('.frames output').textContent"
    before = [desktop.run(script) for script in (profile, line, said)]
    desktop.run(
        "{ const s = document.querySelector('.frames input'); s.value = 20;"
        " s.dispatchEvent(new Event('input')); }"
    )
    after = [desktop.run(script) for script in (profile, line, said)]
    assert before[0] != after[0] and before[1] != after[1] and before[2] != after[2]
    np.testing.assert_array_equal(after[0], desktop.run(column))
    assert after[2].startswith("t = 8.081")
    assert_quiet(desktop)


def test_play_moves_the_slider_until_it_is_pressed_again(desktop: Tab) -> None:
    value = "Number(document.querySelector('.frames input').value)"
    desktop.run("document.querySelector('.frames input').value = 0")
    click(desktop, ".frames button")
    moved = f"new Promise((done) => setInterval(() => {value} > 0 && done(true), 20))"
    assert desktop.run(moved)
    click(desktop, ".frames button")
    reached = desktop.run(value)
    assert 0 < reached < 99
    desktop.run("new Promise((done) => setTimeout(done, 200))")
    assert desktop.run(value) == reached
    assert_quiet(desktop)


def test_zoom_in_one_figure_over_time_zooms_the_others(desktop: Tab) -> None:
    others = FIGURES - {"pressure-section"}
    at_first = {key: range_of(desktop, key) for key in FIGURES}
    desktop.run("document.getElementById('shares').scrollIntoView({ block: 'center' })")
    panel = desktop.run(
        "(({ x, y, width, height }) => [x, y, width, height])"
        "(document.querySelector('#shares .nsewdrag').getBoundingClientRect())"
    )
    left, top, width, height = panel
    desktop.drag((left + width / 4, top + height / 2), (left + width / 2, top + height / 2))
    zoomed = range_of(desktop, "shares")
    span = at_first["shares"][1] - at_first["shares"][0]
    assert zoomed == pytest.approx(
        [at_first["shares"][0] + share * span for share in (0.25, 0.5)], abs=0.01 * span
    )
    for key in others:
        assert range_of(desktop, key) == pytest.approx(zoomed), key
    assert range_of(desktop, "pressure-section") == at_first["pressure-section"]
    # The zoom survives other colours.
    click(desktop, "#scheme")
    assert range_of(desktop, "certificate") == pytest.approx(zoomed)
    click(desktop, "#scheme")
    click(desktop, '.tools[data-plot="certificate"] [data-action="reset"]')
    for key in others:
        assert range_of(desktop, key) == pytest.approx(at_first[key]), key
    assert_quiet(desktop)


def test_buttons_choose_the_view_of_a_figure(tab: Tab, tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 9)
    variable: Any = SimpleNamespace(values=t, unit="s", status="")
    (drawn,) = application_pictures("python", {"time": variable, "a": variable, "b": variable})
    drawn = replace(drawn, views=Views("Show", ("a", "b")))
    page = tmp_path / "report.html"
    page.write_text(document("", "", "", sections([drawn]), [drawn]), encoding="utf-8")
    tab.open(page, DESKTOP)
    visible = "document.getElementById('histories').data.map((t) => t.visible)"
    for chosen in (2, 1):
        click(tab, f'.views[data-plot="histories"] button:nth-of-type({chosen})')
        assert tab.run(visible) == [chosen == 1, chosen == 2]


def test_data_of_a_figure_are_saved_as_csv(desktop: Tab) -> None:
    desktop.run(
        "window.saved = []; URL.createObjectURL = (blob) => { saved.push(blob); return '#'; };"
        "URL.revokeObjectURL = () => null;"
    )
    click(desktop, '.tools[data-plot="separation"] [data-action="csv"]')
    head, *rows = desktop.run("saved[0].text()").splitlines()
    assert head.startswith('"time [s]","observed: ‖x₁ − x₂‖ [µm mm⁰·⁵]"') and len(rows) == 100
    time, observed = (float(value) for value in rows[50].split(",")[:2])
    assert observed == pytest.approx(3 * np.exp(-1.1 * time), rel=1e-12)
    click(desktop, '.tools[data-plot="pressure"] [data-action="csv"]')
    head, *cells = desktop.run("saved[1].text()").splitlines()
    assert head == '"time [s]","place on the boundary [mm]","pressure [MPa]"'
    assert len(cells) == 100 * 360


def test_long_table_is_sorted_by_the_head_of_a_column(desktop: Tab) -> None:
    table = "#about-constants-table"
    names = f"Array.from(document.querySelectorAll('{table} td:first-child'), (c) => c.textContent)"
    values = sorted((float(value), name) for name, _, value, *_ in CONSTANTS)
    assert desktop.run(names) == [name for name, *_ in CONSTANTS]
    click(desktop, f"{table} th:nth-child(3) button")
    assert desktop.run(names) == [name for _, name in values]
    click(desktop, f"{table} th:nth-child(3) button")
    assert desktop.run(names) == [name for _, name in reversed(values)]
    assert desktop.run(f"document.querySelector('{table} [aria-sort]').ariaSort") == "descending"


def pixels(tab: Tab) -> np.ndarray:
    return imread(io.BytesIO(tab.picture("#about-regimes")))[..., :3]


def area(picture: np.ndarray, colour: str) -> int:
    return int((np.abs(picture - np.array(to_rgb(colour))).max(axis=-1) < 2 / 255).sum())


@pytest.mark.slow
def test_page_follows_the_system_to_dark_and_its_switch_back(desktop: Tab) -> None:
    light = pixels(desktop)
    desktop.set_scheme("dark")
    dark = pixels(desktop)
    assert light.std() > 0.05 and dark.std() > 0.05
    assert light.mean() > 0.7 > 0.35 > dark.mean()
    for colour in REGIME_COLOURS:
        assert area(light, colour) > 500, colour
        assert area(dark, DARK[colour]) > 500, colour
    click(desktop, "#scheme")
    assert pixels(desktop).mean() > 0.7
    assert_quiet(desktop)


@pytest.mark.slow
def test_page_is_as_wide_as_a_phone_with_all_tables_unfolded(tab: Tab, page: Path) -> None:
    tab.open(page, PHONE)
    assert overflow(tab) <= 0
    tab.run("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    assert overflow(tab) <= 0
    assert_quiet(tab)


@pytest.mark.thorough
def test_printed_page_is_light_and_unfolded(tab: Tab, page: Path) -> None:
    tab.open(page, DESKTOP, scheme="dark")
    tab.run("window.dispatchEvent(new Event('beforeprint'))")
    assert tab.run("document.querySelectorAll('details:not([open])').length") == 0
    assert tab.run("document.getElementById('shares')._fullLayout.paper_bgcolor") == "#FFFFFF"
    tab.run("window.dispatchEvent(new Event('afterprint'))")
    assert tab.run("document.querySelectorAll('details[open]').length") == 0


@pytest.mark.thorough
def test_slider_of_a_surface_shows_another_time(tab: Tab, tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((30, 20), frames=5))
    tab.open(build_report(run_dir, stills=False), DESKTOP)
    z = "Array.from(document.getElementById('pressure').data[0].z, (row) => Array.from(row))"
    before = tab.run(z)
    tab.run(
        "{ const s = document.querySelector('.frames[data-plot=pressure] input'); s.value = 0;"
        " s.dispatchEvent(new Event('input')); }"
    )
    after = tab.run(z)
    assert np.shape(before) == np.shape(after) == (20, 30) and before != after
    assert_quiet(tab)


@pytest.mark.thorough
def test_names_of_a_user_are_text_in_figures(tab: Tab, tmp_path: Path) -> None:
    """Plotly reads some tags in a text; none of them runs a script."""
    evil = "</script><img src=x onerror='window.ran = 1'><a href='javascript:1'>T</a>"
    t = np.linspace(0.0, 1.0, 9)
    variable = SimpleNamespace(values=t, unit=evil, status="")
    data: Any = {
        "time": SimpleNamespace(values=t, unit=evil, status=""),
        evil: variable,
        "b": variable,
    }
    drawn = application_pictures("python", data)
    page = tmp_path / "report.html"
    page.write_text(document(evil, evil, "", sections(drawn), drawn), encoding="utf-8")
    tab.open(page, DESKTOP)
    assert tab.run("document.querySelectorAll('#histories .main-svg').length") >= 1
    assert tab.run("document.querySelectorAll('img, a[href^=javascript]').length") == 0
    assert tab.run("window.ran") is None
    assert_quiet(tab)


@pytest.mark.thorough
def test_page_cannot_ask_for_anything(tab: Tab, page: Path) -> None:
    tab.open(page, DESKTOP)
    asked = "fetch('https://example.org').then(() => 'answered', () => 'refused')"
    assert tab.run(asked) == "refused"
    assert any("Content Security Policy" in text for text in tab.errors)


@pytest.mark.thorough
def test_broken_page_is_detected(tab: Tab, page: Path, tmp_path: Path) -> None:
    broken = tmp_path / "report.html"
    text = page.read_text(encoding="utf-8")
    broken.write_text(text.replace("startTables();", "startTable();", 1), encoding="utf-8")
    with pytest.raises(AssertionError, match="startTable is not defined"):
        tab.open(broken, DESKTOP)
