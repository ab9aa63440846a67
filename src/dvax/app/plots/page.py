"""The page: one HTML file that holds its pictures, its script and its style.

Nothing is fetched: Plotly's script is written into the file, and figures are JSON beside it.
"""

from collections.abc import Sequence
from importlib.resources import files

from plotly.offline import get_plotlyjs

from dvax.app.plots.picture import Picture, Views
from dvax.app.plots.run_reader import CONTACT, UNFINISHED, RunRecord
from dvax.app.plots.tables import (
    assumptions_table,
    constants_table,
    escaped,
    facts_table,
    headline_cards,
    rates_table,
)
from dvax.app.plots.theme import counted

_HINT = '<br><span class="hint">Drag in a figure to zoom, double-click to return.</span>'


def page(run: RunRecord, pictures: Sequence[Picture], missing: Sequence[str]) -> str:
    """The whole HTML text. `missing` says, a sentence each, which pictures the run cannot give."""
    absent = "".join(f"<li>{escaped(text)}</li>" for text in missing)
    body = f"""{_banner(run)}
<section><h2>Headline figures</h2>{headline_cards(run)}</section>
{sections(pictures)}
{f"<section><h2>Not drawn</h2><ul>{absent}</ul></section>" if absent else ""}
{_stability(run)}
<section><h2>Constants</h2>{constants_table(run)}
<p class="caption">Labels are those of the formulas in the paper. The paper's constants use
magnitudes and not signs: they are conservative, and sharper ones stand beside them where there
are any.</p>
</section>
<section><h2>The run</h2>{facts_table(run.manifest)}</section>"""
    return document(run.title, _subtitle(run), body, has_pictures=bool(pictures))


def sections(pictures: Sequence[Picture]) -> str:
    """The sections of the pictures, one each."""
    return "\n".join(map(_section, pictures))


def document(title: str, subtitle: str, body: str, *, has_pictures: bool) -> str:
    """The whole HTML text of a page with this body."""
    room = files("dvax.app.plots")
    style = (room / "page.css").read_text(encoding="utf-8")
    script = (room / "page.js").read_text(encoding="utf-8")
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escaped(title)} · dvax report</title>
<link rel="icon" href="data:,">
<style>{style}</style>
<script>{get_plotlyjs()}</script>
</head>
<body>
<header>
<h1>{escaped(title)}</h1>
<p>{escaped(subtitle)}{_HINT if has_pictures else ""}</p>
</header>
<main>
{body}
</main>
<script>{script}</script>
</body>
</html>
"""


def _stability(run: RunRecord) -> str:
    """The section on stability; empty where the run has neither constants nor assumptions."""
    rates, assumptions = rates_table(run), assumptions_table(run)
    if not (rates or assumptions):
        return ""
    caption = (
        '<p class="caption">The distance of two trajectories grows at most at this rate. The paper\'s '
        "adds magnitudes; the one with signs accounts for feedback that stabilises.</p>"
    )
    return f"<section><h2>Stability</h2>{rates}{caption if rates else ''}{assumptions}</section>"


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


def _banner(run: RunRecord) -> str:
    """Notices at the top of the page: the run is partial, frames are left out, warnings."""
    lines: list[str] = []
    if run.status in UNFINISHED:
        reach = _reach(run)
        # The manifest of a killed run still says that the run is going on.
        gone = run.status == "running"
        reason = "" if gone else str(run.manifest.get("stop_reason") or "")
        text = " ".join(part for part in (UNFINISHED[run.status], reach, reason) if part)
        head = "No results." if run.trajectory is None else "Partial results."
        lines.append(
            f'<div class="banner partial" role="alert"><b>{head}</b> {escaped(text)}</div>'
        )
    said = "".join(f"<li>{escaped(text)}</li>" for text in (*run.notes, *run.warnings))
    if said:
        lines.append(f'<div class="banner"><b>Notes of the run.</b><ul>{said}</ul></div>')
    return "\n".join(lines)


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


def _section(picture: Picture) -> str:
    # "<" is escaped, so that no text of the run can close the script element.
    figure = str(picture.interactive.to_json()).replace("<", "\\u003c")
    height = picture.interactive["layout"]["height"]
    return f"""<section><h2>{escaped(picture.title)}</h2>{_control(picture)}
<div class="plot" id="{picture.key}" style="min-height:{height}px" role="img"
 aria-label="{escaped(picture.title)}"></div>
<script type="application/json" id="{picture.key}-data">{figure}</script>
<p class="caption">{escaped(picture.caption)}</p></section>"""


def _control(picture: Picture) -> str:
    views = picture.views
    if views is None:
        return ""
    if views.slider:
        return _slider(picture.key, views)
    buttons = "".join(
        f'<button type="button" aria-pressed="{str(index == views.first).lower()}" '
        f'data-view="{index}">{escaped(label)}</button>'
        for index, label in enumerate(views.labels)
    )
    return (
        f'<div class="views" data-plot="{picture.key}" data-count="{len(views.labels)}">'
        f"<span>{escaped(views.name)}</span>{buttons}</div>"
    )


def _slider(key: str, views: Views) -> str:
    labels = "\n".join(views.labels)
    return (
        f'<div class="views" data-plot="{key}" data-count="{len(views.labels)}">'
        f'<label for="{key}-view">{escaped(views.name)}</label>'
        f'<input type="range" id="{key}-view" min="0" max="{len(views.labels) - 1}" step="1" '
        f'value="{views.first}" data-labels="{escaped(labels)}">'
        f"<output>{escaped(views.labels[views.first])}</output></div>"
    )
