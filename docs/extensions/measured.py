"""Tables of measured figures: before the build, each case in docs/measured/*.json, which
`python -m benchmarks --save FILE` writes, becomes docs/generated/measured-CASE.inc for pages.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.layout import duration
from sphinx.application import Sphinx


def write(app: Sphinx) -> None:
    here = Path(app.srcdir)
    target = here / "generated"
    target.mkdir(exist_ok=True)
    for file in sorted((here / "measured").glob("*.json")):
        content = json.loads(file.read_text("utf-8"))
        for section in content["sections"]:
            text = "\n".join(lines(section, content)) + "\n"
            (target / f"measured-{section['name']}.inc").write_text(text, "utf-8")


def lines(section: dict[str, Any], run: dict[str, Any]) -> Iterator[str]:
    """Yield the tables of a case and where they come from, as Markdown."""
    machine = run["machine"]
    if section["comparisons"]:
        head = (
            "case",
            "against",
            "dvax",
            "other",
            "time of the other / dvax",
            "error",
            "its error",
        )
        yield from table(head, [cells(row) for row in section["comparisons"]])
    for given in section["tables"]:
        yield f"\n{given['title']}:\n"
        yield from table(given["header"], given["rows"])
    packages = (("Python", "python"), ("JAX", "jax"), ("SciPy", "scipy"), ("Diffrax", "diffrax"))
    yield (
        f"\n*`python -m benchmarks --only {section['name']}` on {run['date'][:10]}: "
        f"{machine['processor']}, {machine['cores']} cores, load {section['load'].split(',')[0]} at "
        f"the start; {', '.join(f'{name} {machine[key]}' for name, key in packages)}. "
        f"{section['fair']}*"
    )


def cells(row: dict[str, Any]) -> tuple[str, ...]:
    """Return a comparison as the cells of a row; above 1, dvax is faster."""
    spread = row["ratio"]
    if spread is None:
        ratio = "–"
    else:
        values = [spread[name] for name in ("middle", "low", "high")]
        if row["direction"] == "dvax/other":
            values = [1.0 / values[0], 1.0 / values[2], 1.0 / values[1]]
        ratio = "{:.3g} ({:.3g} to {:.3g})".format(*values)
    errors = ("–" if e is None else f"{e:.1e}" for e in (row["error"], row["error_other"]))
    numbers = (duration(row["dvax"]), duration(row["other"]), ratio, *errors)
    return row["case"], row["versus"], *map(on_one_line, numbers)


def on_one_line(number: str) -> str:
    """Return a number that no line breaks, neither before its unit nor at its sign."""
    return (
        number.replace(" (", "\n(").replace(" ", "\u00a0").replace("-", "\u2011").replace("\n", " ")
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield "| " + " | ".join(head) + " |"
    yield "|" + "---|" * len(head)
    for row in rows:
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
