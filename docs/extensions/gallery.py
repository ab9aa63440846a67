"""The pictures of the gallery: one style, and alternative texts that say what is drawn."""

import re
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from cycler import cycler
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform

from dvax.app.plots.theme import INK, MUTED, SERIES

# Curves that colour-blind readers can tell apart; C7 is grey, for limits.
COLOURS = [*SERIES, INK, MUTED]
STYLE = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=COLOURS),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": "medium",
    "figure.constrained_layout.use": True,
    "figure.figsize": (7.2, 4.2),
    "font.size": 10,
    "grid.color": "#e6e6e6",
    "legend.fontsize": "small",
    "legend.framealpha": 0.85,
    "savefig.dpi": 110,
}


def reset(gallery_conf: dict[str, Any], fname: str) -> None:
    """Begin every example with the style."""
    plt.rcdefaults()
    plt.rcParams.update(STYLE)


def description(figure: Any) -> str:
    """Say what a figure draws: the titles, the axes, and the curves with their labels."""
    parts = []
    for axes in figure.axes:
        x, y = axes.get_xlabel(), axes.get_ylabel()
        if not (axes.get_title() or x or y):
            continue
        curves = axes.get_legend_handles_labels()[1]
        text = axes.get_title() or "A panel"
        text += f": {y or 'values'}" + (f" over {x}" if x else "")
        if curves:
            text += f", for {', '.join(curves)}"
        parts.append(text)
    return ". ".join(parts).replace("\n", " ")


def figures(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the open figures, and return the directives that show them."""
    lines: list[str] = []
    for number in plt.get_fignums():
        figure = plt.figure(number)
        path = Path(next(block_vars["image_path_iterator"]))
        figure.savefig(path)
        place = path.relative_to(gallery_conf["src_dir"]).as_posix()
        lines += [f".. image:: /{place}", f"   :alt: {description(figure)}", ""]
    plt.close("all")
    return "\n".join(lines)


ORDER = (
    "mechanics control circuit field game finance ecology derivative ensemble certificate workflow"
).split()


class Order:
    """Sort the examples by subject, and by name within a subject."""

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def __call__(self, name: str) -> tuple[int, str]:
        return ORDER.index(name.split("_")[1]), name


class Thumbnails(SphinxPostTransform):
    """Describe each thumbnail by the title of its example."""

    default_priority = 6

    def run(self, **settings: Any) -> None:
        for image in self.document.findall(nodes.image):
            match = re.search(r"sphx_glr_(plot_\w+)_thumb", image.get("uri", ""))
            if match and not image.get("alt"):
                title = self.env.titles[f"gallery/{match[1]}"].astext()
                image["alt"] = f"Picture of the example: {title}"


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_post_transform(Thumbnails)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
