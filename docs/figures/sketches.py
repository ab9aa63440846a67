"""The sketches of the tutorials, side by side in one picture for each tutorial."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, FancyBboxPatch, Polygon, Rectangle

INK, BLUE, RED = "#222222", "#0072B2", "#D55E00"


def canvas(width=6.4, height=1.9):
    figure, axes = plt.subplots(figsize=(width, height))
    axes.axis("off")
    axes.set_aspect("equal")
    return figure, axes


def wall(axes, x, low, high):
    axes.plot([x, x], [low, high], color=INK)
    for y in np.arange(low, high, 0.2):
        axes.plot([x, x - 0.15], [y, y + 0.15], color=INK, linewidth=0.8)


def coil(axes, start, end, y, turns=6):
    s = np.linspace(0.0, 1.0, 200)
    axes.plot(start + (end - start) * s, y + 0.15 * np.sin(2 * np.pi * turns * s), color=INK)


def arrow(axes, start, end, text, colour=INK, above=0.22):
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.4})
    axes.text(
        (start[0] + end[0]) / 2, max(start[1], end[1]) + above, text, color=colour, ha="center"
    )


def spring():
    figure, axes = canvas()
    wall(axes, 0.0, 0.0, 1.2)
    coil(axes, 0.0, 2.5, 0.6)
    axes.add_patch(Rectangle((2.5, 0.1), 1.0, 1.0, facecolor="#dce6f0", edgecolor=INK))
    axes.text(3.0, 0.6, "m", ha="center", va="center")
    axes.text(1.25, 0.95, "k", ha="center")
    arrow(axes, (3.5, 0.6), (4.8, 0.6), "u,  |u| ≤ 5 N", RED)
    arrow(axes, (2.5, -0.25), (3.3, -0.25), "x", BLUE, -0.5)
    axes.add_patch(FancyBboxPatch((5.3, 0.15), 1.9, 0.9, boxstyle="round,pad=0.05", facecolor="white",
                                  edgecolor=INK))  # fmt: skip
    axes.text(6.25, 0.6, "controller", ha="center", va="center")
    axes.set(xlim=(-0.4, 7.5), ylim=(-0.9, 1.5))
    return figure


def bar():
    figure, axes = canvas()
    for k in range(12):
        axes.add_patch(
            Rectangle((0.5 * k, 0.4), 0.5, 0.5, facecolor="#f3e3d3", edgecolor=INK, lw=0.6)
        )
        if 3 <= k <= 8:
            arrow(axes, (0.5 * k + 0.25, -0.15), (0.5 * k + 0.25, 0.38), "", RED)
    axes.text(3.0, -0.5, "heaters: 0 ≤ u ≤ 4", color=RED, ha="center")
    axes.text(-0.15, 0.62, "0 °C", ha="right", va="center", color=BLUE)
    axes.text(6.15, 0.62, "0 °C", ha="left", va="center", color=BLUE)
    axes.text(3.0, 1.1, "x(t, s): temperature of a bar", ha="center")
    axes.set(xlim=(-1.0, 7.2), ylim=(-0.8, 1.5))
    return figure


def market():
    figure, axes = canvas()
    for k, name in enumerate(("firm 1", "firm 2")):
        axes.add_patch(
            Rectangle((0.0, 1.0 - 1.1 * k), 1.4, 0.8, facecolor="#dce6f0", edgecolor=INK)
        )
        axes.text(0.7, 1.4 - 1.1 * k, name, ha="center", va="center")
        arrow(axes, (1.4, 1.4 - 1.1 * k), (3.4, 0.95 - 0.2 * k), f"u{'₁₂'[k]} ≤ cap", RED, 0.1)
    axes.add_patch(Circle((4.1, 0.85), 0.65, facecolor="#f3e3d3", edgecolor=INK))
    axes.text(4.1, 0.85, "price p", ha="center", va="center")
    arrow(axes, (6.4, 0.85), (4.8, 0.85), "demand α(t)", BLUE)
    axes.set(xlim=(-0.4, 7.2), ylim=(-0.4, 2.2))
    return figure


def body():
    figure, axes = canvas(6.4, 2.4)
    top = np.array([[0.0, 0.0], [6.0, 0.0], [5.2, 1.4], [0.8, 1.4]])
    axes.add_patch(Polygon(top, facecolor="#dce6f0", edgecolor=INK))
    s = np.linspace(-1.3, 1.3, 60)
    axes.plot(3.0 + s, 1.43 + 0.45 * s**2, color=INK, linewidth=2)
    arrow(axes, (3.0, 2.8), (3.0, 2.0), "", RED)
    axes.text(3.2, 2.5, "punch, δ(t)", color=RED)
    axes.text(4.75, 1.6, "contact", color=BLUE)
    axes.text(3.0, 0.6, "your mesh", ha="center")
    for x in np.arange(0.0, 6.0, 0.25):
        axes.plot([x, x - 0.12], [0.0, -0.15], color=INK, linewidth=0.8)
    axes.text(6.2, -0.1, "clamped", color=BLUE)
    axes.set(xlim=(-0.6, 7.6), ylim=(-0.4, 3.0))
    return figure


def circuit():
    figure, axes = canvas(6.4, 2.2)
    axes.plot([0, 1.2], [1.5, 1.5], color=INK)
    axes.plot([0, 0], [0, 0.4], color=INK)
    axes.plot([0, 0], [1.1, 1.5], color=INK)
    axes.add_patch(Circle((0.0, 0.75), 0.35, facecolor="white", edgecolor=INK))
    axes.text(-0.5, 0.75, "V1", ha="right", va="center")
    axes.add_patch(Polygon([[1.2, 1.3], [1.2, 1.7], [1.6, 1.5]], facecolor=RED, edgecolor=INK))
    axes.plot([1.6, 1.6], [1.3, 1.7], color=INK)
    axes.text(1.4, 1.85, "D1", ha="center", color=RED)
    axes.plot([1.6, 5.0], [1.5, 1.5], color=INK)
    for x, name in ((3.0, "C1"), (5.0, "R1")):
        axes.plot([x, x], [1.5, 1.0], color=INK)
        axes.plot([x, x], [0.0, 0.5], color=INK)
        axes.add_patch(Rectangle((x - 0.2, 0.5), 0.4, 0.5, facecolor="white", edgecolor=INK))
        axes.text(x + 0.35, 0.75, name, va="center")
    axes.plot([0, 5.0], [0, 0], color=INK)
    axes.text(0.3, 1.65, "a"), axes.text(2.3, 1.65, "b"), axes.text(2.3, 0.1, "0")
    axes.set(xlim=(-1.2, 6.2), ylim=(-0.3, 2.2))
    return figure


def draw(path: Path) -> None:
    with plt.rc_context({"svg.fonttype": "path", "svg.hashsalt": "dvax", "font.size": 10}):
        for sketch in (spring, bar, market, body, circuit):
            figure = sketch()
            figure.savefig(path.with_name(f"sketch-{sketch.__name__}.svg"), bbox_inches="tight")
            plt.close(figure)
        path.touch()
