"""The report in a browser: no console error, every figure drawn, its controls work, no request."""

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from tests.app.plots.synthetic import Recipe, write_run

from dvax.app.plots import build_report
from dvax.app.plots.theme import REGIME_COLOURS

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine (Debian: apt-get install chromium)"
)

# Written into a copy of the page: collects what goes wrong, then reports as JSON in the title.
COLLECT = """<script>
window.wrong = [];
window.addEventListener("error", function (e) { window.wrong.push(String(e.message)); });
window.addEventListener("unhandledrejection", function (e) {
  window.wrong.push(String(e.reason));
});
console.error = console.warn = function () { window.wrong.push(Array.from(arguments).join(" ")); };
window.addEventListener("load", function () {
  setTimeout(function () {
    const drawn = {};
    document.querySelectorAll(".plot").forEach(function (p) {
      drawn[p.id] = p.querySelectorAll(".main-svg").length;
    });
    const moved = {};
    document.querySelectorAll(".views").forEach(function (v) {
      const button = v.querySelectorAll("button")[1], slider = v.querySelector("input");
      if (button) button.click();
      if (slider) { slider.value = 2; slider.dispatchEvent(new Event("input")); }
      const data = document.getElementById(v.dataset.plot).data || [];
      moved[v.dataset.plot] = data.slice(0, Number(v.dataset.count)).map(function (t) {
        return t.visible;
      });
    });
    document.title = JSON.stringify({
      wrong: window.wrong, drawn: drawn, moved: moved,
      requests: performance.getEntriesByType("resource").length,
      overflow: document.documentElement.scrollWidth - window.innerWidth
    });
  }, 1500);
});
</script>"""


def chromium(*arguments: str, profile: Path) -> subprocess.CompletedProcess[str]:
    assert CHROMIUM is not None
    common = (
        "--headless --no-sandbox --disable-gpu --disable-background-networking --no-first-run "
        "--disable-component-update --disable-sync --hide-scrollbars --virtual-time-budget=20000 "
        "--enable-logging=stderr --v=0"
    ).split()
    return subprocess.run(
        [CHROMIUM, *common, f"--user-data-dir={profile}", *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def look_at(page: Path, width: int) -> dict[str, Any]:
    """Load a copy of `page` that reports on itself; return its report, and the console output."""
    probe = page.with_name(f"probe-{width}.html")
    text = page.read_text(encoding="utf-8")
    probe.write_text(text.replace("<head>", f"<head>{COLLECT}", 1), encoding="utf-8")
    done = chromium(
        "--dump-dom",
        f"--window-size={width},900",
        f"file://{probe}",
        profile=page.parent / "profile",
    )
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout, re.DOTALL)
    assert title is not None, f"the page did not report:\n{done.stderr[-2000:]}"
    report = json.loads(title[1].replace("&gt;", ">").replace("&lt;", "<").replace("&amp;", "&"))
    report["console"] = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return report


@pytest.fixture(scope="module")
def curve(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_dir = write_run(tmp_path_factory.mktemp("curve") / "run", Recipe((2000,), frames=200))
    return build_report(run_dir, stills=False)


@pytest.mark.thorough
@pytest.mark.parametrize("width", [1280, 500])
def test_report_draws_every_figure_without_a_console_error(curve: Path, width: int) -> None:
    report = look_at(curve, width)
    assert report["wrong"] == []
    assert report["console"] == []
    assert set(report["drawn"]) == {
        *("pressure", "regimes", "shares", "histories", "certificate", "separation")
    }
    assert min(report["drawn"].values()) >= 1
    assert report["requests"] == 0
    assert report["overflow"] <= 0, "the page is wider than the screen"
    # The second button was pressed: of each map's three views, the second shows.
    assert report["moved"] == {key: [False, True, False] for key in ("pressure", "regimes")}


@pytest.mark.thorough
def test_report_slider_shows_another_frame(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((30, 20), frames=5))
    report = look_at(build_report(run_dir, stills=False), 1280)
    assert report["wrong"] == [] and report["console"] == []
    assert report["moved"]["pressure"] == [False, False, True, False, False]
    assert report["drawn"]["pressure"] >= 1


def test_report_picture_is_not_blank(curve: Path, tmp_path: Path) -> None:
    shot = tmp_path / "shot.png"
    chromium(
        f"--screenshot={shot}", "--window-size=1280,4200", f"file://{curve}", profile=tmp_path / "p"
    )
    pixels = imread(shot)[..., :3]
    assert pixels.std() > 0.05
    for colour in REGIME_COLOURS:
        near = np.abs(pixels - np.array(to_rgb(colour))).max(axis=-1) < 2 / 255
        assert near.sum() > 2000, f"no area in the regime colour {colour}"


def test_broken_page_is_detected(curve: Path, tmp_path: Path) -> None:
    broken = tmp_path / "report.html"
    text = curve.read_text(encoding="utf-8")
    broken.write_text(text.replace("Plotly.newPlot(", "Plotly.newPlotty(", 1), encoding="utf-8")
    report = look_at(broken, 1280)
    assert report["wrong"] != []
    assert max(report["drawn"].values()) == 0
