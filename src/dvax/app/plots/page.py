"""The page: one HTML file that holds its pictures, its scripts and its style.

Nothing is fetched: Plotly and the data of the figures lie in the file, compressed. First come the
sentences that matter, then the pictures, then the tables, folded away.
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

from dvax.app.plots import web
from dvax.app.plots.lead import lead
from dvax.app.plots.picture import Frames, Picture, Views
from dvax.app.plots.run_reader import CONTACT, UNFINISHED, RunRecord
from dvax.app.plots.tables import (
    assumptions_table,
    constants_table,
    escaped,
    facts_table,
    figures_table,
    files_table,
    rates_table,
    status_mark,
)
from dvax.app.plots.theme import counted

_HINTS = """<p class="hint">Drag in a picture to zoom; pictures over the same axis follow. Double-click
to return.</p>
<noscript><p class="banner">The pictures need JavaScript. The folder figures holds them as
PNG.</p></noscript>
<p class="banner" id="old-browser" hidden>This browser cannot unpack the pictures. Update it, or open
the PNG files in the folder figures.</p>"""
# The browser refuses every request of the page. Plotly compiles its parallel axes ('unsafe-eval').
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data: blob:"
)
_TOOLS = {"reset": "Reset zoom", "csv": "CSV", "png": "PNG", "svg": "SVG"}
_ANCHOR = "about-"
"""Before the key of a picture, the id of its section."""


class Part(NamedTuple):
    """A part of the page, for its contents and for its body."""

    key: str
    title: str
    text: str


def page(run: RunRecord, pictures: Sequence[Picture], missing: Sequence[str]) -> str:
    """The whole HTML text. `missing` says, a sentence each, which pictures the run cannot give."""
    absent = "".join(f"<li>{escaped(text)}</li>" for text in missing)
    parts = [
        *sections(pictures),
        *section("missing", "Not drawn", f"<ul>{absent}</ul>" if absent else ""),
        *section("figures", "Key figures", figures_table(run)),
        *fold("certificate", "Assumptions and rates", _stability(run), len(run.assumptions)),
        *fold("constants", "Constants", _constants(run), len(run.constants)),
        *fold("configuration", "Configuration", _configuration(run)),
        *fold("provenance", "Provenance", facts_table(run.manifest)),
        *fold("files", "Files and hashes", files_table(run)),
    ]
    top = f"{_alert(run)}{lead_section(lead(run))}{_notes(run)}"
    return document(run.title, _subtitle(run), top, parts, pictures)


def document(
    title: str, subtitle: str, top: str, parts: Sequence[Part], pictures: Sequence[Picture]
) -> str:
    """The whole HTML text of a page: `top` comes before the contents, and the `parts` after them."""
    data = ""
    if pictures:
        data = (
            f'<script type="text/plain" id="plotly">{web.plotly_bundle()}</script>\n'
            f'<script type="text/plain" id="data">{web.figures(pictures)}</script>\n'
        )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<title>{escaped(title)} · dvax report</title>
<link rel="icon" href="data:,">
<style>{web.style()}</style>
</head>
<body>
<header>
<div class="top"><h1>{escaped(title)}</h1><button type="button" id="scheme" hidden></button></div>
<p>{escaped(subtitle)}</p>
</header>
<main>
{top}
{_contents(parts)}
{_HINTS if pictures else ""}
{"".join(part.text for part in parts)}
</main>
{data}<script type="module">{web.script()}</script>
</body>
</html>
"""


def sections(pictures: Sequence[Picture]) -> list[Part]:
    """The sections of the pictures, one each."""
    return [part for picture in pictures for part in section(*_drawn(picture))]


def section(key: str, title: str, content: str) -> list[Part]:
    """A part that is always shown; none without content."""
    place = f"{_ANCHOR}{key}"
    text = f'<section id="{place}"><h2>{escaped(title)}</h2>{content}</section>\n'
    return [Part(place, title, text)] if content else []


def fold(key: str, title: str, content: str, rows: int = 0) -> list[Part]:
    """A part that is folded away; none without content."""
    place = f"{_ANCHOR}{key}-table"
    count = f' <span class="count">({rows})</span>' if rows else ""
    head = f"<summary>{escaped(title)}{count}</summary>"
    text = f'<details id="{place}">{head}{content}</details>\n'
    return [Part(place, title, text)] if content else []


def lead_section(said: Sequence[str]) -> str:
    """The sentences that matter first; the status words of the theory in their colours."""
    paragraphs = "".join(f"<p>{_marked(text)}</p>" for text in said)
    return f'<section class="lead" aria-label="Summary">{paragraphs}</section>\n'


def _marked(text: str) -> str:
    words = r"(?<=\bis )(?:proved|declared|estimated|refuted)\b"
    # A line does not end within a number, or after its sign.
    joined = re.sub(r"(?:≤ )?\d[\d.]*e[-+]\d+", r'<span class="whole">\g<0></span>', escaped(text))
    return re.sub(words, lambda m: status_mark(m[0]), joined)


def _contents(parts: Sequence[Part]) -> str:
    """Links to the parts of the page, in their order."""
    links = "".join(f'<li><a href="#{part.key}">{escaped(part.title)}</a></li>' for part in parts)
    return f'<nav class="contents" aria-label="Contents"><ul>{links}</ul></nav>'


def _constants(run: RunRecord) -> str:
    caption = (
        '<p class="caption">Labels are those of the formulas in the paper. The constants of the paper '
        "use absolute values and not signs: they are conservative. Sharper ones are listed beside them "
        "where there are any.</p>"
    )
    return constants_table(run) + caption if run.constants else ""


def _configuration(run: RunRecord) -> str:
    return f"<pre>{escaped(run.config_text)}</pre>" if run.config_text else ""


def _stability(run: RunRecord) -> str:
    """Assumptions and rates; empty where the run has neither."""
    rates, assumptions = rates_table(run), assumptions_table(run)
    if rates:
        rates = (
            f"<h3>Rate of separation</h3>{rates}"
            '<p class="caption">The distance of two trajectories grows at most at this rate. The rate '
            "of the paper ignores signs; the one with signs accounts for feedback that stabilises.</p>"
        )
    return assumptions + rates


def _subtitle(run: RunRecord) -> str:
    parts = [f"dvax {run.manifest.get('dvax') or ''}".strip()]
    if run.model != CONTACT:
        parts.append(f"model {run.model}, {run.manifest.get('fit', '')}".rstrip(", "))
    elif run.trajectory is not None:
        parts.append(f"model {CONTACT}")
        points = " × ".join(str(n) for n in run.boundary_shape)
        parts.append(f"{points} points, {counted(len(run.time), 'frame')}")
    parts.append(run.status)
    return " · ".join(parts)


def _alert(run: RunRecord) -> str:
    """The notice that the run is partial, with its reason; empty for one that reached its end."""
    if run.status not in UNFINISHED:
        return ""
    # The manifest of a killed run still says that the run is going on.
    reason = "" if run.status == "running" else str(run.manifest.get("stop_reason") or "")
    text = " ".join(part for part in (UNFINISHED[run.status], _reach(run), reason) if part)
    head = "No results." if run.trajectory is None else "Partial results."
    return alert(f"<b>{head}</b> {escaped(text)}")


def alert(content: str) -> str:
    """A notice at the top of the page."""
    return f'<div class="banner partial" role="alert">{content}</div>\n'


def _notes(run: RunRecord) -> str:
    """Frames that are left out, and warnings; empty without any."""
    said = "".join(f"<li>{escaped(text)}</li>" for text in (*run.notes, *run.warnings))
    return f'<div class="banner"><b>Notes of the run.</b><ul>{said}</ul></div>' if said else ""


def _reach(run: RunRecord) -> str:
    if run.trajectory is None:
        return "No results were written."
    if run.model != CONTACT:
        return ""  # the stop reason states how far the run came
    unit = run.unit("time")
    end = run.config.get("time", {}).get("end")
    aim = f" of {end:g} {unit}" if isinstance(end, int | float) else ""
    held = counted(len(run.time), "frame")
    return f"It holds {held}, up to t = {run.time[-1]:.6g} {unit}{aim}."


def _drawn(picture: Picture) -> tuple[str, str, str]:
    """Key, title and content of the section of a picture."""
    key, height = escaped(picture.key), picture.interactive["layout"]["height"]
    tools = "".join(
        f'<button type="button" data-action="{action}">{label}</button>'
        for action, label in _TOOLS.items()
    )
    views = "" if picture.views is None else _buttons(key, picture.views)
    slider = "" if picture.frames is None else _slider(key, picture.frames)
    content = f"""{views}{slider}
<div class="plot" id="{key}" style="min-height:{height}px" role="img"
 aria-label="{escaped(picture.description)}"></div>
<p class="caption">{escaped(picture.caption)}</p>
<div class="tools" data-plot="{key}" hidden>{tools}</div>"""
    return key, picture.title, content


def _buttons(key: str, views: Views) -> str:
    buttons = "".join(
        f'<button type="button" aria-pressed="{str(index == 0).lower()}">{escaped(label)}</button>'
        for index, label in enumerate(views.labels)
    )
    return f'<div class="views" data-plot="{key}"><span>{escaped(views.name)}</span>{buttons}</div>'


def _slider(key: str, frames: Frames) -> str:
    return (
        f'<div class="frames" data-plot="{key}"><button type="button">Play</button>'
        f'<label for="{key}-time">Time</label>'
        f'<input type="range" id="{key}-time" min="0" max="{len(frames.labels) - 1}" step="1" '
        f'value="{frames.first}"><output>{escaped(frames.labels[frames.first])}</output></div>'
    )
