"""The report of a case: comparisons with targets, further tables, and notes."""

from dataclasses import dataclass, field
from typing import Literal

from .clock import Spread, ratios, spread

Direction = Literal["dvax/other", "other/dvax"]


@dataclass(frozen=True)
class Target:
    """What a figure must reach: `sign` "≤" or "≥", in the unit that `unit` names."""

    sign: Literal["≤", "≥"]
    value: float
    reached: float
    unit: str = ""

    @property
    def met(self) -> bool:
        return self.reached <= self.value if self.sign == "≤" else self.reached >= self.value

    def __str__(self) -> str:
        return f"{self.sign} {self.value:g}{self.unit}"


@dataclass(frozen=True)
class Comparison:
    """One row: dvax beside another way to the same answer.

    `dvax`, `other`: seconds for what `case` says (None: not a time of that side); `ratio` is formed
    round by round, in the direction that `direction` names; errors are absolute, in the largest
    entry of x, against a reference that the section names.
    """

    case: str
    versus: str
    dvax: float | None
    other: float | None
    ratio: Spread | None = None
    direction: Direction = "dvax/other"
    error: float | None = None
    error_other: float | None = None
    target: Target | None = None
    rounds: int = 0


@dataclass(frozen=True)
class Table:
    """Figures that are no comparison of times."""

    title: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]


@dataclass
class Section:
    """A case: `fair` says what is compared and why the other side is not held back."""

    title: str
    fair: str
    comparisons: list[Comparison] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    skipped: str | None = None


def compare(
    case: str,
    versus: str,
    dvax: list[float],
    other: list[float],
    *,
    direction: Direction = "dvax/other",
    error: float | None = None,
    error_other: float | None = None,
    target: tuple[Literal["≤", "≥"], float] | None = None,
) -> Comparison:
    """The row of two series of samples taken in turn, with its target on the median ratio."""
    ratio = ratios(dvax, other) if direction == "dvax/other" else ratios(other, dvax)
    return Comparison(
        case=case,
        versus=versus,
        dvax=spread(dvax).middle,
        other=spread(other).middle,
        ratio=ratio,
        direction=direction,
        error=error,
        error_other=error_other,
        target=None if target is None else Target(*target, ratio.middle, "×"),
        rounds=len(dvax),
    )
