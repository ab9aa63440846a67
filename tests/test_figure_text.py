"""A figure has the same text everywhere, with its certified digits."""

import json
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.app.plots.synthetic import Recipe, write_run

from dvax._figure_text import entry_text, figure_text
from dvax.app.cli.run import _print_figures
from dvax.app.plots import build_report

FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64).filter(
    lambda v: v == 0 or 1e-290 < abs(v) < 1e290
)
ERRORS = st.floats(min_value=1e-280, max_value=1e280)


@given(FINITE)
def test_figure_without_an_error_bound_has_ten_digits(value: float) -> None:
    assert float(figure_text(value)) == pytest.approx(value, rel=5e-10, abs=0.0)


@given(FINITE, ERRORS)
def test_figure_with_an_error_bound_contains_the_certified_interval(
    value: float, error: float
) -> None:
    shown, told = figure_text(value, error).split(" ± ")
    # The bound is rounded up, and the value off by no more than a unit of the bound's first digit.
    assert error <= float(told) * (1 + 1e-12) <= 1.11 * error
    assert abs(float(shown) - value) <= max(error, 1e-16 * abs(value)) * (1 + 1e-9)


def test_figure_text_of_examples() -> None:
    assert figure_text(1286032.12345) == "1286032.123"
    assert figure_text(-0.0) == "0"
    assert figure_text(3) == "3" and figure_text(None) == "not known"
    assert figure_text([1.5, 2.5, 3.5, 4.5, 5.5]) == "1.5, 2.5, 3.5, 4.5, … (5 in all)"
    assert figure_text([1.23456789, 2.0], [1e-4, 1e-2]) == "1.2346 ± 1e-04, 2 ± 1e-02"
    assert figure_text(2.5, 0.0) == "2.5"


@given(st.floats(min_value=1e-280, max_value=1e280))
def test_bound_text_has_two_digits_rounded_up(value: float) -> None:
    shown = entry_text({"value": value, "bound": "estimated"})
    assert shown.startswith("≤ ")
    told = float(shown.removeprefix("≤ "))
    assert value <= told * (1 + 1e-12) <= 1.11 * value
    digits = shown.removeprefix("≤ ").split("e")[0].replace(".", "").strip("0")
    assert len(digits) <= 2


def test_bound_text_of_examples() -> None:
    texts = [
        entry_text({"value": value, "bound": "proved"})
        for value in (1065.322453, 0.3101843489, 2.3316511e-11, 0.0, 99.1)
    ]
    assert texts == ["≤ 1100", "≤ 0.32", "≤ 2.4e-11", "0", "≤ 100"]
    assert entry_text({"value": None, "bound": "estimated"}) == "not known"


def test_figure_text_agrees_on_terminal_page_and_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,), frames=21))
    summary = {
        "objective": {"value": 4231335.287107123, "unit": "trip cost", "meaning": "no error"},
        "peak": {"value": 2.676123456789, "unit": "in", "meaning": "certified", "error": 3.1e-5},
        "bound": {
            "value": 3.1415e-7,
            "unit": "MPa mm",
            "meaning": "(estimated)",
            "bound": "estimated",
        },
        "tiny": {"value": -1.23456789012345e-13, "unit": "1", "meaning": "small"},
    }
    (run_dir / "summary.json").write_text(json.dumps(summary))
    _print_figures(summary)
    said = capsys.readouterr().out
    page = build_report(run_dir, stills=False).read_text(encoding="utf-8")
    cells = re.findall(r'<span class="number" title="([^"]*)">(.*?)</span></td>', page)
    assert len(cells) == 4
    # A unit never breaks.
    assert re.search(r"3\.2e-07 <span class=\"unit\">MPa mm</span>", page)
    assert re.search(r"\.unit \{[^}]*white-space: nowrap", page)
    for (whole, shown), entry in zip(cells, summary.values(), strict=True):
        text = entry_text(entry)
        assert text in said and shown.startswith(text) and float(whole) == entry["value"]
