"""The stability section: the parts of the certified rate, and the status of the assumptions."""

from pathlib import Path
from typing import Any

import pytest

from dvax.app.plots.run_reader import AssumptionRow, ConstantRow, RunRecord
from dvax.app.plots.tables import assumptions_table, rates_table

VALUES = {"omega": -1.0, "M": 2.0, "alpha_f": 0.3, "beta_f": 0.5, "L": 0.4, "growth_rate": 0.0}


def record(values: dict[str, Any], assumptions: tuple[AssumptionRow, ...] = ()) -> RunRecord:
    rows = tuple(
        ConstantRow(name, name, value, "1/s", "label", "proved", "meaning")
        for name, value in values.items()
    )
    return RunRecord(Path("."), {}, {}, {}, rows, (), None, assumptions)


def test_stability_table_parts_add_up_and_the_largest_is_named() -> None:
    text = rates_table(record(VALUES | {"sharp_decay_rate": 0.75}))
    shown = [line.split("</td>") for line in text.split("<tr>")[2:]]
    cells = [[cell.split(">")[-1] for cell in row[:4]] for row in shown]
    parts = {row[1]: row for row in cells}
    assert parts["M α_f"][2:] == ["0.6 1/s", "the largest term"]
    assert parts["M β_f L"][2:] == ["0.4 1/s", ""]
    assert parts["ω + M L̃"][2:] == ["0 1/s", "their distance stays bounded"]
    assert parts["μ"][2:] == ["-0.75 1/s", "trajectories approach"]
    assert parts["ω + M L̃ − μ"][2] == "0.75 1/s"


@pytest.mark.parametrize("missing", VALUES)
def test_stability_table_is_absent_without_constants(missing: str) -> None:
    assert rates_table(record({k: v for k, v in VALUES.items() if k != missing})) == ""


def test_stability_assumptions_are_shown_and_escaped() -> None:
    row = AssumptionRow("ass:x", "a < b", "refuted", "at t = 1 & x = 2")
    text = assumptions_table(record(VALUES, (row,)))
    assert "a &lt; b" in text and "at t = 1 &amp; x = 2" in text
    assert 'class="status refuted"' in text
    assert assumptions_table(record(VALUES)) == ""
