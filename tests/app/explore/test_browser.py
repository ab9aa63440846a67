"""The page in a browser: it loads, a slider changes a number, nothing is wrong, nothing is blank."""

import io
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from matplotlib.image import imread
from tests.app.browser import CHROMIUM, Tab, browser
from tests.app.explore.line import Line

from dvax.app.explore.server import Server
from dvax.app.explore.subject import AbstractSubject

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine (Debian: apt-get install chromium)"
)
NUMBER = "(document.querySelector('#numbers .text') || {}).textContent"
MOVE = """(function () {
  const slider = document.querySelector('#sliders input[type=range]');
  slider.value = %d;
  slider.dispatchEvent(new Event('input'));
  slider.dispatchEvent(new Event('change'));
})()"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def served(subject: AbstractSubject) -> Iterator[Server]:
    server = Server(subject)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    yield from served(Line())


def check_page(page: Tab, server: Server) -> None:
    assert page.errors == []
    assert page.requests and all(url.startswith(server.url) for url in page.requests)
    width = page.run("document.documentElement.scrollWidth - window.innerWidth")
    assert width <= 0, "the page is wider than the screen"
    pixels = imread(io.BytesIO(page.picture()))[..., :3]
    assert pixels.std() > 0.05


@pytest.mark.parametrize(("width", "dark"), [(1400, False), (390, True)])
def test_page_changes_a_number_when_a_slider_moves(
    page: Tab, server: Server, width: int, dark: bool
) -> None:
    page.open(server.url, width, 844, "dark" if dark else "light")
    assert page.wait_for(NUMBER) == "1 mm/s"
    page.run(MOVE % 300)  # three quarters of two decades: 0.1 · 10^1.5
    page.wait_for(f"{NUMBER} === '3.162 mm/s'")
    assert page.run(
        "document.querySelector('#sliders [type=range]').getAttribute('aria-valuetext')"
    ) == ("3.162 mm/s")
    labels = "Array.from(document.querySelectorAll('.plot')).map(p => p.getAttribute('aria-label'))"
    assert page.run(labels) == ["The line. x over time", "Level at t = 0.5 s. "]
    shown = "document.querySelector('.plot').data.map(trace => trace.visible)"
    chosen = "document.querySelector('.views [aria-pressed=true]').textContent"
    assert (page.run(shown), page.run(chosen)) == ([True, False], "place")
    page.run("Array.from(document.querySelectorAll('.views button'))[1].click()")
    assert (page.run(shown), page.run(chosen)) == ([False, True], "rate")
    # In one script, as a hand moves it: an answer between the two would set the slider again.
    page.run(
        "const f = document.getElementById('frame'); f.value = 8; f.dispatchEvent(new Event('input'))"
    )
    page.wait_for("document.querySelector('#frames h2').textContent === 'Level at t = 0.8 s'")
    check_page(page, server)


def test_page_shows_an_error_and_recovers(page: Tab, server: Server) -> None:
    page.open(server.url, 800)
    page.wait_for(f"{NUMBER} === '1 mm/s'")
    page.run(MOVE % 400)
    page.wait_for("!document.getElementById('error').hidden")
    assert "at most 9" in page.run("document.getElementById('error').textContent")
    page.run(MOVE % 200)
    page.wait_for("document.getElementById('error').hidden")
    assert page.errors == []


@pytest.mark.slow
def test_page_saves_pictures_and_the_configuration(
    page: Tab, server: Server, tmp_path: Path
) -> None:
    page.open(server.url, 800)
    page.wait_for(f"{NUMBER} === '1 mm/s'")
    page("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    for words, start in (("PNG", b"\x89PNG"), ("SVG", b"<svg"), ("Configuration (TOML)", b"a = 1")):
        page.run(
            f"Array.from(document.querySelectorAll('button')).find(b => b.textContent === '{words}')"
            ".click()"
        )
        suffix = {"PNG": "png", "SVG": "svg"}.get(words, "toml")
        for _ in range(400):
            page.run("new Promise(done => setTimeout(done, 25))")
            if found := list(tmp_path.glob(f"*.{suffix}")):
                break
        assert found[0].read_bytes().startswith(start)
    assert page.errors == []


@pytest.mark.thorough
@pytest.mark.parametrize(("width", "dark"), [(1400, True), (390, False)])
def test_page_of_the_contact_law_draws_everything(page: Tab, width: int, dark: bool) -> None:
    from dvax.app.explore.contact import ContactSubject, load_default

    for server in served(ContactSubject(load_default())):
        page.open(server.url, width, 844, "dark" if dark else "light")
        rate = "document.querySelector('[data-name=\"sharp decay rate\"] .text')"
        page.wait_for(f"({rate} || {{}}).textContent === '1.05 1/s'")
        page.run(MOVE % 300)
        page.wait_for(f"{rate}.textContent.startsWith('3.2')")
        page.wait_for("document.getElementById('prediction').textContent.startsWith('Dashed: α')")
        page.run("document.getElementById('stability').scrollIntoView()")
        page.wait_for("document.querySelector('#drawing-stability .main-svg') !== null")
        drawn = page.run("document.querySelectorAll('.plot .main-svg').length > 4")
        assert drawn
        page.run("window.scrollTo(0, 0)")
        check_page(page, server)
