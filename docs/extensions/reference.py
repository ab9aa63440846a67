"""The API reference: a page for each public package, and one for each public name.

The pages are written before the build, below docs/reference/api/, which git ignores.
"""

import inspect
import re
from pathlib import Path

from docs.extensions.public_names import PACKAGES, public_names
from sphinx.application import Sphinx

FOLDER = "reference/api"
BACKREFERENCES = "generated/backreferences"


FIRST = ("Problem", "solve", "Solution", "verify", "bound_error", "Bound", "Constants", "Event")
"""The names that stand first on the page of `dvax`; the others follow by name."""


def rank(name: str) -> tuple[int, str]:
    """The order of names on the page of a package: by name, abstract classes last."""
    short = name.rpartition(".")[2]
    if name.removeprefix("dvax.") in FIRST:
        return FIRST.index(short), ""
    return len(FIRST) + short.startswith("Abstract"), short.lower()


def summary(thing: object) -> str:
    """The first sentence of the docstring."""
    text = inspect.getdoc(thing) or ""
    return " ".join(text.split("\n\n")[0].split())


def directive(thing: object) -> tuple[str, list[str]]:
    if inspect.isclass(thing):
        return "autoclass", ["   :members:", "   :show-inheritance:"]
    if callable(thing):
        return "autofunction", []
    return "autodata", ["   :no-value:"]


def page(app: Sphinx, name: str, thing: object) -> str:
    kind, options = directive(thing)
    package, _, short = name.rpartition(".")
    lines = [
        f":html_theme.sidebar_secondary.remove: {'' if inspect.isclass(thing) else 'true'}",
        "",
        short,
        "=" * len(short),
        "",
        f".. currentmodule:: {package}",
        "",
        f".. {kind}:: {name}",
        *options,
        "",
    ]
    used = Path(app.srcdir) / BACKREFERENCES / f"{name}.examples"
    if used.is_file() and used.stat().st_size:
        lines += [f"Examples that use {short}", "-" * (len(short) + 18), ""]
        lines += [f".. minigallery:: {name}", ""]
    return "\n".join(lines)


def index(package: str, names: dict[str, object]) -> str:
    lines = [
        package, "=" * len(package), "", f".. module:: {package}", "", ".. markdown::", "",
        "   " + PACKAGES[package][0].upper() + PACKAGES[package][1:] + ".", "",
        "   | name | |", "   |---|---|",
    ]  # fmt: skip
    for name, thing in names.items():
        text = summary(thing).replace("|", r"\|")
        lines.append(f"   | `{name}` | {text} |")
    lines += ["", ".. toctree::", "   :hidden:", ""]
    return "\n".join([*lines, *(f"   {name}" for name in names), ""])


def write(app: Sphinx) -> None:
    folder = Path(app.srcdir) / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    pages: dict[str, str] = {}
    for package in PACKAGES:
        names = {n: t for n, t in public_names().items() if n.rpartition(".")[0] == package}
        names = dict(sorted(names.items(), key=lambda item: rank(item[0])))
        pages[f"package-{package}"] = index(package, names)
        pages |= {name: page(app, name, thing) for name, thing in names.items()}
    for old in folder.glob("*.rst"):
        if old.stem not in pages:
            old.unlink()
    for stem, text in pages.items():
        file = folder / f"{stem}.rst"
        # Sphinx reads a page again when its file is newer.
        if not file.is_file() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")


LINK = re.compile(r'(href="[^"#]*reference/api/(dvax[\w.]*)\.html)#([\w.]+)"')


def repair(app: Sphinx, pagename: str, template: str, context: dict, doctree: object) -> None:
    """Correct the links from source code to the reference.

    viewcode gives all objects of a module the package of the first, but two packages may export
    from one module.
    """

    def anchor(match: re.Match[str]) -> str:
        name = match[2].rpartition(".")[2]
        return f'{match[1]}#{match[2]}{match[3].partition(f".{name}")[2]}"'

    if pagename.startswith("_modules/") and "body" in context:
        context["body"] = LINK.sub(anchor, context["body"])


def setup(app: Sphinx) -> dict[str, bool]:
    # After the gallery, which writes which examples use a name.
    app.connect("builder-inited", write, priority=900)
    app.connect("html-page-context", repair)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
