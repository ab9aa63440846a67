"""Docstrings in Markdown, and links from names in code to the reference.

autodoc reads docstrings as reStructuredText. `process` puts each into a directive `markdown`, which
parses it as MyST parses the pages.
"""

import re
from typing import Any

from docs.extensions.public_names import UNIQUE, public_name_of
from docutils import nodes
from docutils.utils import new_document
from myst_parser.parsers.sphinx_ import MystParser
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import make_refnode


class Markdown(SphinxDirective):
    """Parse the content as Markdown."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        source, _ = self.get_source_info()
        document = new_document(source, self.state.document.settings)
        MystParser().parse("\n".join(self.content), document)
        return document.children


def process(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    if lines and lines[0] != ".. markdown::":
        lines[:] = [".. markdown::", "", *(f"   {line}" for line in lines), ""]


def bases(app: Sphinx, name: str, obj: Any, options: Any, bases: list[Any]) -> None:
    """Name the base classes of dvax only."""
    bases[:] = [base for base in bases if public_name_of(f"{base.__module__}.{base.__qualname__}")]
    bases[:] = bases or [object]


def resolve(app: Sphinx, env: Any, node: addnodes.pending_xref, content: nodes.Node) -> Any:
    """Link a name of dvax by the place where it is public; leave other names as text."""
    if node.get("refdomain") != "py":
        return None
    public = public_name_of(node["reftarget"])
    if public is None:
        return content
    place = env.domains.python_domain.objects.get(public)
    if place is None:
        return content
    return make_refnode(app.builder, node["refdoc"], place.docname, place.node_id, content, public)


class LinkNames(SphinxPostTransform):
    """Link code spans such as `dvax.Problem`, `Box` or `sol.regimes()` to the reference."""

    default_priority = 5

    def run(self, **settings: Any) -> None:
        for block in self.document.findall(nodes.literal_block):
            # A session ends with an empty line for doctest.
            if block.rawsource == block.astext():
                block.rawsource = block.rawsource.rstrip()
                block[:] = [nodes.Text(block.rawsource)]
        objects = self.env.domains.python_domain.objects
        for node in list(self.document.findall(nodes.literal)):
            if isinstance(node.parent, nodes.reference | addnodes.pending_xref):
                continue
            text = node.astext().removesuffix("()")
            name = re.sub(r"\(.*\)$", "", text)
            name = UNIQUE.get(name, name)
            place = objects.get(name)
            if place is None or (place.docname == self.env.docname and name.count(".") < 2):
                continue
            link = make_refnode(
                self.app.builder, self.env.docname, place.docname, place.node_id, node.deepcopy()
            )
            node.replace_self(link)


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("markdown", Markdown)
    app.add_post_transform(LinkNames)
    app.connect("autodoc-process-docstring", process)
    app.connect("autodoc-process-bases", bases)
    app.connect("missing-reference", resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
