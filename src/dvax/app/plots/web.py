"""The parts of the page that a browser runs: style, scripts, and compressed data."""

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs

from dvax.app.plots.picture import Change, Frames, Picture
from dvax.app.plots.theme import DARK, PAGE_COLOURS

# In this order: a later one uses the functions of an earlier one.
SCRIPTS = ("unpack", "draw", "zoom", "frames", "download", "tables", "main")


def style() -> str:
    """Return page.css after the colours of the theme as variables."""
    colours = " ".join(f"--{name}: light-dark({a}, {b});" for name, (a, b) in PAGE_COLOURS.items())
    return f":root {{ {colours} }}\n{_text('page.css')}"


def script() -> str:
    """Return the script of the page, a module of one scope."""
    return "\n".join(_text(f"{name}.js") for name in SCRIPTS)


def compressed(text: str) -> str:
    """Return a text as base64 of gzip, which the page unpacks; the same text gives the same result."""
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()


@cache
def plotly_bundle() -> str:
    """Return Plotly's script, compressed: it takes two thirds of a page."""
    return compressed(get_plotlyjs())


def figures(pictures: Sequence[Picture]) -> str:
    """Return what the scripts draw, compressed: figures by their keys, and the dark colours."""
    drawn = {picture.key: _figure(picture) for picture in pictures}
    parts = ", ".join(f"{json.dumps(key)}: {text}" for key, text in drawn.items())
    return compressed(f'{{"figures": {{{parts}}}, "dark": {json.dumps(DARK)}}}')


def _text(name: str) -> str:
    return (files("dvax.app.plots") / "web" / name).read_text(encoding="utf-8")


def _figure(picture: Picture) -> str:
    about: dict[str, Any] = {
        "zoom": picture.zoom,
        "views": 0 if picture.views is None else len(picture.views.labels),
        "frames": None if picture.frames is None else _frames(picture.frames),
    }
    # Plotly writes arrays as base64, too.
    return f'{{"figure": {picture.interactive.to_json()}, "about": {json.dumps(about)}}}'


def _frames(frames: Frames) -> Mapping[str, Any]:
    return {
        "times": _packed(np.asarray(frames.times, float)),
        "labels": frames.labels,
        "changes": [_change(change) for change in frames.changes],
    }


def _change(change: Change) -> Mapping[str, Any]:
    values = None if change.values is None else _packed(change.values)
    return {
        "trace": change.trace, "attribute": change.attribute, "values": values,
        "section": change.section,
    }  # fmt: skip


def _packed(values: np.ndarray) -> Mapping[str, Any]:
    """Return an array as Plotly writes arrays into JSON."""
    return {
        "dtype": f"{values.dtype.kind}{values.dtype.itemsize}",
        "bdata": base64.b64encode(values.tobytes()).decode(),
        "shape": ", ".join(map(str, values.shape)),
    }
