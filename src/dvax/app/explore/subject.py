"""What a page explores: parameters, and for their values drawings, figures and a certificate."""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from dvax.app.plots.picture import Views

Values = Mapping[str, float]
"""A number for the key of every parameter."""


class Outdated(Exception):
    """A newer question has arrived: the answer to this one is no longer of interest."""


@dataclass(frozen=True)
class Parameter:
    """A number of the configuration that a slider moves between `low` and `high`: evenly, or with `log`
    evenly in the logarithm; `whole` numbers have no derivative."""

    key: str
    label: str
    unit: str
    low: float
    high: float
    value: float
    log: bool = False
    whole: bool = False

    def step(self, value: float) -> float:
        """Return a change that can be seen: a quarter of the value, or a tenth of the range at 0."""
        return 0.25 * (abs(value) or 0.4 * (self.high - self.low))


@dataclass(frozen=True)
class Drawing:
    """A figure for Plotly: `data` and `layout` as its JSON has them, with arrays in place of lists.

    `views`: traces of which one is visible at a time; `has_time`: whether its horizontal axis is the
    time, so that it marks the time of the frame that is shown."""

    key: str
    title: str
    caption: str
    data: list[Any]
    layout: Mapping[str, Any]
    views: Views | None = None
    has_time: bool = False


@dataclass(frozen=True)
class Number:
    """A headline figure: its name, value and unit as text, and its meaning."""

    name: str
    text: str
    unit: str
    meaning: str


@dataclass(frozen=True)
class Certificate:
    """How much is known of the error bound (proved, declared, estimated or nothing), in sentences."""

    status: str
    sentences: tuple[str, ...]


class AbstractFrames(abc.ABC):
    """Drawings of one saved time. `times`: all of them, in `unit`."""

    times: Any
    unit: str

    @abc.abstractmethod
    def draw(self, frame: int) -> list[Drawing]:
        """Return the drawings at the saved time of this number."""


@dataclass(frozen=True)
class Question:
    """Values of the parameters, and what to predict: from the values `base`, which differ from these in
    the parameter `slider` at most. With `derivative` its derivative is computed where it is not known,
    which takes another run where there is no faster way."""

    values: Values
    base: Values
    slider: str | None = None
    derivative: bool = False


@dataclass(frozen=True)
class Answer:
    """What is drawn for the values of a question.

    `prediction` says what the dashed curves are; `has_more`: whether a question with `derivative` would
    add them."""

    drawings: list[Drawing]
    numbers: list[Number]
    certificate: Certificate
    frames: AbstractFrames | None = None
    prediction: str = ""
    has_more: bool = False
    notes: tuple[str, ...] = field(default=())


class AbstractSubject(abc.ABC):
    """Something to explore.

    - `title`, `subtitle`: of the page; `parameters`: its sliders, none for results that are fixed;
    - `planes`: the keys of parameters that may span a map of stability;
    - `exports`: what `export` writes: "configuration", "code".
    """

    title: str
    subtitle: str
    parameters: tuple[Parameter, ...]
    planes: tuple[str, ...]
    exports: tuple[str, ...]

    @abc.abstractmethod
    def solve(self, question: Question, check: Callable[[], None]) -> Answer:
        """Solve and draw. It calls `check` between parts of long work, which raises `Outdated`.

        **Raises:** `dvax.InputError` and `dvax.SolveError`.
        """

    @abc.abstractmethod
    def stability_map(self, values: Values, across: str, upward: str) -> Drawing:
        """Return the certified boundary and the observed rate over the plane of two parameters."""

    @abc.abstractmethod
    def export(self, kind: str, values: Values) -> tuple[str, str]:
        """Return the name and the text of a file that gives the same numbers."""


def value_text(value: float) -> str:
    """Return a value of a parameter for a legend."""
    return f"{value:.4g}"
