"""A subject without JAX: x(t) = a t, with the slider a."""

from collections.abc import Callable
from typing import Any

import numpy as np

from dvax.app.explore.drawing import layout, line
from dvax.app.explore.subject import (
    AbstractFrames,
    AbstractSubject,
    Answer,
    Certificate,
    Drawing,
    Number,
    Parameter,
    Question,
    Values,
)
from dvax.app.plots.picture import Views
from dvax.app.plots.theme import BLUE, VERMILLION
from dvax.errors import input_error

TIMES = np.linspace(0.0, 1.0, 11)
VIEWS = Views("Show the", ("place", "rate"))


class LineFrames(AbstractFrames):
    def __init__(self, slope: float):
        self.times, self.unit, self._slope = TIMES, "s", slope

    def draw(self, frame: int) -> list[Drawing]:
        x = np.array([0.0, 1.0])
        y = np.full(2, self._slope * TIMES[frame])
        title = f"Level at t = {TIMES[frame]:.1f} s"
        axes = layout(200, ("place", "m"), ("level", "mm"))
        return [Drawing("level", title, "", [line(x, y, "level", VERMILLION)], axes)]


class Line(AbstractSubject):
    title, subtitle = "A line", "x(t) = a t"
    parameters = (Parameter("a", "a, slope", "mm/s", 0.1, 10.0, 1.0, log=True),)
    planes: tuple[str, ...] = ()
    exports = ("configuration",)

    def __init__(self) -> None:
        self.wait: Callable[[], Any] = lambda: None

    def solve(self, question: Question, check: Callable[[], None]) -> Answer:
        self.wait()
        check()
        a = question.values["a"]
        if a > 9.0:
            raise input_error("a", f"{a:g}", "it is at most 9", "Move it back")
        curves = [line(TIMES, a * TIMES, "x", BLUE), line(TIMES, a + 0 * TIMES, "rate", BLUE)]
        axes = layout(240, ("time", "s"), ("x", "mm"))
        return Answer(
            [Drawing("curve", "The line", "x over time", curves, axes, VIEWS, has_time=True)],
            [Number("slope", f"{a:g}", "mm/s", "of the line")],
            Certificate("proved", ("The line is exact.",)),
            LineFrames(a),
        )

    def stability_map(self, values: Values, across: str, upward: str) -> Drawing:
        raise NotImplementedError

    def export(self, kind: str, values: Values) -> tuple[str, str]:
        return "line.toml", f"a = {values['a']}\n"
