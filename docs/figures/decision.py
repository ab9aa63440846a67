"""The decision figure of docs/howto/class.md: from a law to what to do with it."""

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

INSIDE, LIMIT, OUTSIDE, QUESTION = "#d7ecd9", "#fdf0c8", "#f6d5c9", "#e8eef7"


def box(axes, x, y, text, colour, width=2.5, height=0.86) -> None:
    axes.add_patch(
        FancyBboxPatch(
            (x - width / 2, y - height / 2), width, height, facecolor=colour, edgecolor="#444444",
            boxstyle="round,pad=0.02,rounding_size=0.08", linewidth=0.8,
        )
    )  # fmt: skip
    axes.text(x, y, text, ha="center", va="center", fontsize=9)


def arrow(axes, start, end, text="", side=0.0) -> None:
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": "#444444", "lw": 0.9})
    if text:
        middle = ((start[0] + end[0]) / 2 + side, (start[1] + end[1]) / 2)
        axes.text(*middle, text, fontsize=8.5, style="italic", va="center", ha="center",
                  bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0})  # fmt: skip


QUESTIONS = (
    "Does the state jump\n(impact, reset, switch)?",
    "Does the set of u\ndepend on the state x?",
    "Does u jump where x\nis smooth (relay, Coulomb)?",
    "Is u determined by the law\nalone: is γ > 0?",
)
ANSWERS = (
    ("dvax.Event with reset\nsolved; no bound after it", LIMIT),
    ("outside: penalty on x,\nor a tool for K(x)", OUTSIDE),
    ("layer of width ε:\nu = clip(g/ε, −r, r)", LIMIT),
    ("add a small γ:\nr_on, 1/β, ε u", LIMIT),
)


def draw(path: Path) -> None:
    with plt.rc_context({"svg.fonttype": "path", "svg.hashsalt": "dvax"}):
        figure, axes = plt.subplots(figsize=(7.4, 6.6))
        axes.set(xlim=(-1.7, 6.0), ylim=(-6.6, 1.2))
        axes.axis("off")
        box(axes, 0.0, 0.6, "Your law: x' = A x + f(t, x, u)", "#ffffff", width=3.0)
        for k, question in enumerate(QUESTIONS):
            y = -0.8 - 1.35 * k
            box(axes, 0.0, y, question, QUESTION, width=3.0)
            arrow(
                axes,
                (0.0, y + 0.92),
                (0.0, y + 0.46),
                "" if k == 0 else "yes" if k == 4 else "no",
                0.25,
            )
            answer, colour = ANSWERS[k]
            box(axes, 4.3, y, answer, colour, width=2.9)
            arrow(axes, (1.54, y), (2.82, y), "no" if k == 3 else "yes")
        arrow(axes, (0.0, -5.30), (0.0, -5.70), "yes", 0.25)
        box(axes, 0.0, -6.14, "In the class: solve, bound,\ndifferentiate", INSIDE, width=3.0)
        box(axes, 4.3, -6.14, "dvax.verify says so,\nand by which proof", INSIDE, width=2.9)
        arrow(axes, (1.54, -6.14), (2.82, -6.14))
        figure.savefig(path, bbox_inches="tight")
        plt.close(figure)
