"""The tables of the page: figures, constants, assumptions, rates, facts of the manifest."""

import html
import json
from collections.abc import Mapping
from typing import Any

from dvax._figure_text import entry_text
from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.theme import number, quantity

# manifest key: the words of the page. Whatever else the manifest holds follows, under its own name.
FACTS = {
    "status": "status",
    "stop_reason": "why it stopped",
    "started": "started",
    "finished": "finished",
    "method": "method",
    "steps": "steps",
    "run_seconds": "run time [s]",
    "compile_seconds": "compile time [s]",
    "precision": "precision",
    "device": "device",
    "platform": "platform",
    "dvax": "dvax",
    "python": "Python",
    "git_commit": "git commit",
}
SHOWN_ELSEWHERE = ("constants", "assumptions", "title", "data", "files")
_ROWS_TO_SORT = 8
"""Tables with so many rows are sorted by a click on the head of a column."""


def figures_table(run: RunRecord) -> str:
    """summary.json: a row for each figure; the whole number is the tooltip of the shown one."""
    rows = []
    for name, entry in run.summary.items():
        if name == "status":
            continue  # it stands at the top of the page, and among the facts of the run
        value = entry.get("value")
        unit = escaped(quantity("", str(entry.get("unit", ""))))
        shown = f'{escaped(entry_text(entry))} <span class="unit">{unit}</span>'.removesuffix(
            ' <span class="unit"></span>'
        )
        whole = "" if isinstance(value, list) else f' title="{escaped(str(value))}"'
        rows.append(
            (
                f"<code>{escaped(name)}</code>",
                f'<span class="number"{whole}>{shown}</span>',
                escaped(str(entry.get("meaning", ""))),
            )
        )
    if not rows:
        return '<p class="caption">The run wrote no figures: they are made when it ends.</p>'
    return table(("figure", "value", "meaning"), rows)


def files_table(run: RunRecord) -> str:
    """The files that the run read, with their hashes, and those that it wrote; empty without any."""
    rows = [
        (escaped(str(name)), "read", f"<code>{escaped(str(about.get('sha256', '')))}</code>",
         escaped(number(about.get("bytes", ""))))
        for name, about in (run.manifest.get("data") or {}).items()
    ]  # fmt: skip
    rows += [(escaped(str(name)), "written", "", "") for name in run.manifest.get("files") or ()]
    return table(("file", "use", "SHA-256", "bytes"), rows) if rows else ""


def constants_table(run: RunRecord) -> str:
    """Each constant with its value, its formula's label in the paper, its status and meaning."""
    head = ("constant", "symbol", "value", "paper label", "status", "meaning")
    rows = [
        (
            f"<code>{escaped(row.name)}</code>",
            escaped(row.symbol),
            escaped(quantity(row.value, row.unit)),
            f"<code>{escaped(row.label)}</code>" if row.label else "",
            status_mark(row.status),
            escaped(row.meaning),
        )
        for row in run.constants
    ]
    if not rows:
        return '<p class="caption">The run directory names no constants.</p>'
    return table(head, rows)


def assumptions_table(run: RunRecord) -> str:
    """Each assumption of the theory with its status and how that is known; empty without any."""
    rows = [
        (
            f"<code>{escaped(row.label)}</code>",
            escaped(row.statement),
            status_mark(row.status),
            escaped(row.why),
        )
        for row in run.assumptions
    ]
    return table(("assumption", "what it says", "status", "how it is known"), rows) if rows else ""


def rates_table(run: RunRecord) -> str:
    """The terms of the certified rate of separation, beside the one-sided rate: the largest term is
    the one to improve."""
    constants = {row.name: row for row in run.constants}
    needed = ("omega", "M", "alpha_f", "beta_f", "L", "growth_rate")
    if not all(isinstance(getattr(constants.get(n), "value", None), int | float) for n in needed):
        return ""
    omega, M, alpha_f, beta_f, L, growth = (float(constants[name].value) for name in needed)
    state, response = M * alpha_f, M * beta_f * L
    largest = "the largest term"
    rows = [
        ("growth of the semigroup", "ω", omega, ""),
        ("f in the state", "M α_f", state, largest if state >= response else ""),
        ("f in the response", "M β_f L", response, largest if response > state else ""),
        ("all together", "ω + M L̃", growth, _sense(growth)),
    ]
    sharp = constants.get("sharp_decay_rate")
    if sharp is not None:
        mu = -float(sharp.value)
        rows.append(("with signs", "μ", mu, _sense(mu)))
        rows.append(("gap between the two rates", "ω + M L̃ − μ", growth - mu, ""))
    unit = constants["growth_rate"].unit
    cells = [
        tuple(map(escaped, (words, symbol, quantity(rate, unit), remark)))
        for words, symbol, rate, remark in rows
    ]
    return table(("part of the rate", "symbol", "value", "remark"), cells)


def _sense(rate: float) -> str:
    if rate == 0:
        return "their distance stays bounded"
    return "trajectories approach" if rate < 0 else "trajectories may separate"


def facts_table(manifest: Mapping[str, Any]) -> str:
    """The manifest, in reading order; nested values one a line."""
    known = [(FACTS[key], manifest[key]) for key in FACTS if key in manifest]
    others = [
        (_words(key), value)
        for key, value in manifest.items()
        if key not in FACTS and key not in SHOWN_ELSEWHERE
    ]
    rows = [(escaped(name), _fact(value)) for name, value in [*known, *others]]
    return table(("fact", "value"), rows, kind="pairs")


def _fact(value: Any) -> str:
    if isinstance(value, Mapping):
        lines = [f"{escaped(str(key))}: {_fact(item)}" for key, item in value.items()]
        return "<br>".join(lines) if lines else "none"
    if isinstance(value, list):
        plain = [item if isinstance(item, str) else json.dumps(item) for item in value]
        return "<br>".join(map(escaped, plain)) if plain else "none"
    if value is None:
        return "none"
    return escaped(number(value))


def table(head: tuple[str, ...], rows: list[tuple[str, ...]], kind: str = "rows") -> str:
    """An HTML table whose cells carry their column's name: a phone shows each row as a list."""
    top = "".join(f"<th>{escaped(name)}</th>" for name in head)
    body = "".join(
        "<tr>"
        + "".join(
            f'<td data-name="{escaped(name)}">{cell}</td>'
            for name, cell in zip(head, row, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    sorts = " sortable" if kind == "rows" and len(rows) >= _ROWS_TO_SORT else ""
    rows_of = f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody>"
    return f'<div class="scroll"><table class="{kind}{sorts}">{rows_of}</table></div>'


def _words(name: str) -> str:
    words = name.replace("_", " ")
    return f"{words.removesuffix(' si')} (SI)" if words.endswith(" si") else words


def status_mark(status: str) -> str:
    """A status word in its colour."""
    return f'<span class="status {escaped(status)}">{escaped(status)}</span>'


def escaped(text: str) -> str:
    """Text as it stands in a page."""
    return html.escape(text, quote=True)
