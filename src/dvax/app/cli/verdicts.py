"""Which statements of the theory hold for a system, told from its constants."""

from collections.abc import Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]


def outside_the_class(rows: Sequence[Row]) -> list[Row]:
    """The constants that put a system outside the class: γ not positive, or anything refuted."""
    return [
        row
        for row in rows
        if row["status"] == "refuted" or (row["name"] == "gamma" and not row["value"] > 0)
    ]


def verdicts(rows: Sequence[Row]) -> list[tuple[str, str, str]]:
    """Statement, verdict and reason. Only the first decides whether the system is in the class."""
    known = {row["name"]: row for row in rows}
    gamma, decay, q = known["gamma"], known["decay_rate"], known["q_rho"]
    return [
        (
            "one response at every state",
            _word(gamma["value"] > 0, gamma),
            f"γ > 0 ({gamma['label']}); every figure of a run rests on it",
        ),
        (
            "certified decay",
            _word(decay["value"] > 0, decay),
            f"η − M L̃ > 0 ({decay['label']}); a run is well posed without it",
        ),
        (
            "projection route",
            _word(q["value"] < 1, q),
            f"q_ρ < 1 ({q['label']}); a narrower proof of the first line, not needed",
        ),
    ]


def _word(holds: bool, row: Row) -> str:
    """`proved` and its weaker relatives belong to what holds; a sufficient condition that fails
    refutes nothing but itself."""
    return f"holds, {row['status']}" if holds else "does not hold"
