"""The colours of the report and of the documentation have contrast, and differ for every kind of
colour vision.

Contrast is that of WCAG 2.2 (success criteria 1.4.3 and 1.4.11). Colour blindness is simulated by the
matrices of Machado, Oliveira and Fernandes (2009, severity 1) on linear RGB, and distances are those of
Oklab (Ottosson 2020), times 100: about 2 is a just noticeable difference.
"""

import re
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest

from dvax.app.plots.theme import (
    DARK,
    INK,
    MUTED,
    PAGE_COLOURS,
    REGIME_COLOURS,
    SERIES,
    SURFACE,
)

ROOT = Path(__file__).parents[3]
TEXT, GRAPHIC = 4.5, 3.0
LEAST_DISTANCE = 10.0
VISION = {
    "trichromacy": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
         [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
         [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
         [0.004733, 0.691367, 0.303900]]
    ),
}  # fmt: skip
TO_CONES = np.array(
    [[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566],
     [0.0883024619, 0.2817188376, 0.6299787005]]
)  # fmt: skip
TO_OKLAB = np.array(
    [[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099],
     [0.0259040371, 0.7827717662, -0.8086757660]]
)  # fmt: skip
SCHEMES = ("light", "dark")


def linear(colour: str) -> np.ndarray:
    """Linear RGB of #rrggbb."""
    values = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def contrast(one: str, other: str) -> float:
    low, high = sorted(float(linear(c) @ [0.2126, 0.7152, 0.0722]) for c in (one, other))
    return (high + 0.05) / (low + 0.05)


def oklab(colour: str, vision: str) -> np.ndarray:
    seen = np.clip(VISION[vision] @ linear(colour), 0.0, 1.0)
    return TO_OKLAB @ np.cbrt(TO_CONES @ seen)


def distance(one: str, other: str, vision: str) -> float:
    return 100 * float(np.linalg.norm(oklab(one, vision) - oklab(other, vision)))


def shown(colour: str, scheme: str) -> str:
    return colour if scheme == "light" else DARK[colour]


def page(name: str, scheme: str) -> str:
    return PAGE_COLOURS[name][SCHEMES.index(scheme)]


def test_contrast_and_distance_of_closed_forms() -> None:
    assert contrast("#000000", "#FFFFFF") == pytest.approx(21.0)
    assert contrast("#777777", "#777777") == 1.0
    assert distance("#000000", "#FFFFFF", "trichromacy") == pytest.approx(100.0, abs=1e-4)
    # Red and green of one lightness are near for a deuteranope, and far for others.
    red, green = "#C00000", "#6F6B00"
    assert distance(red, green, "deuteranopia") < 6 < 15 < distance(red, green, "tritanopia")


@pytest.mark.parametrize("scheme", SCHEMES)
def test_texts_of_the_page_have_contrast(scheme: str) -> None:
    for text in ("ink", "muted", "accent"):
        for ground in ("surface", "page"):
            assert contrast(page(text, scheme), page(ground, scheme)) >= TEXT, (text, ground)
    for status in ("proved", "declared", "estimated", "refuted", "rule"):
        assert contrast(page("ink", scheme), page(status, scheme)) >= TEXT, status
    assert contrast(page("on-accent", scheme), page("accent", scheme)) >= TEXT


@pytest.mark.parametrize("scheme", SCHEMES)
def test_graphic_parts_of_the_page_have_contrast(scheme: str) -> None:
    for part in ("accent", "border", "notice", "alarm"):
        for ground in ("surface", "page"):
            assert contrast(page(part, scheme), page(ground, scheme)) >= GRAPHIC, (part, ground)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_curves_have_contrast_and_texts_of_figures_too(scheme: str) -> None:
    ground = shown(SURFACE, scheme)
    for colour in SERIES:
        assert contrast(shown(colour, scheme), ground) >= GRAPHIC, colour
    for colour in (INK, MUTED):
        assert contrast(shown(colour, scheme), ground) >= TEXT, colour


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_curves_differ_for_every_vision(scheme: str, vision: str) -> None:
    colours = [shown(colour, scheme) for colour in SERIES]
    near = {pair: distance(*pair, vision) for pair in combinations(colours, 2)}
    assert min(near.values()) >= LEAST_DISTANCE, min(near, key=lambda pair: near[pair])


@pytest.mark.parametrize("scheme", SCHEMES)
def test_regimes_have_contrast_between_neighbours_and_an_order_in_grey(scheme: str) -> None:
    colours = [shown(colour, scheme) for colour in REGIME_COLOURS]
    for pair in pairwise(colours):
        assert contrast(*pair) >= GRAPHIC, pair
    for vision in VISION:
        assert min(distance(*pair, vision) for pair in combinations(colours, 2)) >= LEAST_DISTANCE
    grey = [contrast(colour, shown(SURFACE, scheme)) for colour in colours]
    assert grey == sorted(grey)


def test_documentation_draws_with_the_same_curves() -> None:
    # Read and not imported: Sphinx is not among the packages of the tests.
    text = (ROOT / "docs" / "extensions" / "gallery.py").read_text(encoding="utf-8")
    assert "from dvax.app.plots.theme import INK, MUTED, SERIES" in text
    assert "COLOURS = [*SERIES, INK, MUTED]" in text


def colours_in(files: list[Path]) -> set[str]:
    found = (re.findall(r"#[0-9a-fA-F]{6}\b", file.read_text(encoding="utf-8")) for file in files)
    return {colour.upper() for colours in found for colour in colours}


def test_pictures_of_the_documentation_use_strong_lines_and_pale_areas() -> None:
    """On white paper each colour is a line, with contrast, or an area below text."""
    for colour in colours_in(sorted((ROOT / "docs" / "figures").glob("*.py"))):
        on_white = contrast(colour, "#FFFFFF")
        assert on_white >= GRAPHIC or contrast(colour, "#222222") >= TEXT, colour


def test_style_of_the_documentation_has_no_colours_of_its_own() -> None:
    """The colours of the site are those of its theme, which has light and dark ones."""
    text = (ROOT / "docs" / "_static" / "dvax.css").read_text(encoding="utf-8")
    assert not re.search(r"(?<!-)\b(?:color|background(?:-color)?|fill|stroke)\s*:", text)
