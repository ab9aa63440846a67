"""The sentences at the top of a report agree with summary.json and manifest.json."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.app.plots.synthetic import Recipe, write_run

from dvax._figure_text import entry_text
from dvax.app.plots.lead import lead
from dvax.app.plots.page import lead_section
from dvax.app.plots.run_reader import AssumptionRow, ConstantRow, RunRecord, read_run
from dvax.app.plots.store import Store


class Times:
    """Saved times of a model without a store."""

    values, unit = np.linspace(0.0, 2.0, 5), "ms"


def run(model: str = "circuit", **about: Any) -> RunRecord:
    """A run of a ready model that reached its end."""
    manifest = {
        "model": model, "status": "finished", "steps": 107, "method": "ExpRosenbrock: it is exact",
        "states": 3, "responses": 1, "fit": "exact",
    }  # fmt: skip
    store = Store({}, {"time": Times()}, 5)
    record = RunRecord(Path("."), manifest, {}, {}, (), (), store)
    return replace(record, **about)


def bound(status: str, value: Any = 3.14e-7, **more: Any) -> dict[str, Any]:
    entry = {"value": value, "unit": "mm", "meaning": f"of the state ({status})", "bound": status}
    return {"error_bound": entry | more}


def constants(**statuses: str) -> tuple[ConstantRow, ...]:
    return tuple(ConstantRow(n, n, 1.0, "", "label", s, "") for n, s in statuses.items())


def test_lead_says_what_was_solved() -> None:
    assert lead(run())[0] == (
        "This run solved a circuit with ideal diodes with 3 states and 1 response from 0 to 2 ms in "
        "107 steps of ExpRosenbrock, with 5 saved times."
    )


@pytest.mark.parametrize(
    "model", ["fem-contact", "frame", "market", "mpc", "thermostat", "traffic"]
)
def test_lead_names_every_ready_model(model: str) -> None:
    assert f"solved the model {model}" not in lead(run(model))[0]


def test_lead_of_an_unknown_model_has_its_name() -> None:
    assert "solved the model pendulum" in lead(run("pendulum"))[0]


def test_lead_of_a_problem_of_your_own_names_its_file() -> None:
    record = run("python")
    told = lead(replace(record, manifest={**record.manifest, "fit": "a problem of your own: a.py"}))
    assert "This run solved a problem of your own (a.py)" in told[0]


@pytest.mark.parametrize("status", ["proved", "declared", "estimated"])
def test_lead_gives_the_bound_with_its_status(status: str) -> None:
    summary = bound(status, relative=2.4e-9)
    (told,) = [text for text in lead(run(summary=summary)) if "error bound" in text]
    assert told.startswith(f"The error bound is {status}: {entry_text(summary['error_bound'])} mm")
    assert "at most 2.4e-09 of the norm of the solution" in told
    # The bound and the ratio are rounded up, never down.
    assert "3.2e-07" in told


@pytest.mark.parametrize(
    ("summary", "words"),
    [
        ({"peak": {"value": 1.0, "unit": "", "meaning": ""}}, "No error bound was computed."),
        (bound("not known", None), "The error bound is not known"),
        (bound("proved", "inf"), "The error bound is not finite, so it states nothing"),
        (bound("proved", None), "The error bound is not finite, so it states nothing"),
        (bound("estimated", relative=3.0), "more than the norm of the solution"),
    ],
)
def test_lead_says_that_a_bound_is_missing_or_useless(summary: Any, words: str) -> None:
    assert any(words in text for text in lead(run(summary=summary)))


def test_lead_uses_the_smallest_bound_of_the_state() -> None:
    summary = {
        "error_bound_x": bound("proved", 1e-3)["error_bound"],
        "error_bound_sharp_x": bound("proved", 1e-4)["error_bound"],
        "rest_error_bound": bound("proved", 1e-9)["error_bound"],
        "error_bound_u": bound("proved", 1e-8)["error_bound"],
    }
    assert "The error bound is proved: ≤ 1e-04 mm" in lead(run(summary=summary))[1]


@pytest.mark.parametrize("status", ["proved", "declared", "estimated"])
def test_lead_calls_well_posedness_by_its_weakest_assumption(status: str) -> None:
    rows = (AssumptionRow("a", "", "proved", ""), AssumptionRow("b", "", status, ""))
    told = lead(run(assumptions=rows))[-1]
    assert told.startswith(f"Well-posedness is {status}: ")
    shown = "all 2 needed assumptions" if status == "proved" else f"1 is proved, 1 is {status} (b)"
    assert shown in told and told.endswith("The model is in the class exactly.")


def test_lead_gives_the_reason_of_a_refuted_assumption() -> None:
    rows = (
        AssumptionRow("a", "", "proved", ""),
        AssumptionRow("b", "h is continuous in t", "refuted", "h jumps at t = 6"),
    )
    told = lead(run(assumptions=rows))[-1]
    assert told.startswith(
        "An assumption of well-posedness is refuted: h is continuous in t (h jumps at t = 6). For the "
        "others, all 1 needed assumption are proved."
    )


def test_lead_ignores_sufficient_conditions_that_are_not_needed() -> None:
    rows = (
        AssumptionRow("a", "", "proved", ""), AssumptionRow("b", "", "refuted", "", is_required=False),
    )  # fmt: skip
    assert "Well-posedness is proved: all 1 needed assumption" in lead(run(assumptions=rows))[-1]


def test_lead_falls_back_to_the_constants() -> None:
    told = lead(run(constants=constants(gamma="proved", L_F="estimated")))[-1]
    assert told.startswith("Well-posedness is estimated: of 2 constants")
    rows = (ConstantRow("gamma", "γ", -0.5, "", "", "proved", ""),)
    assert "not shown: γ = -0.5 is not positive" in lead(run(constants=rows))[-1]


@pytest.mark.parametrize(
    ("status", "words"),
    [
        ("interrupted", "The run was interrupted before its end"),
        ("failed", "The run failed before its end"),
        ("killed", "The run was killed before its end"),
        ("running", "The run had not ended"),
    ],
)
def test_lead_says_how_an_unfinished_run_ended(tmp_path: Path, status: str, words: str) -> None:
    recipe = Recipe((40,), frames=21, written=11, status=status)
    told = lead(read_run(write_run(tmp_path / "some", recipe)))[0]
    assert "the contact law at 40 points of the boundary from 0 to 20 (of 40) s" in told
    assert words in told and told.endswith("The results are partial.")
    empty = lead(read_run(write_run(tmp_path / "none", replace(recipe, written=0))))
    assert "There are no results for the contact law" in empty[0]
    assert not any("error bound" in text for text in empty)


def test_lead_says_that_a_run_was_resumed(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe((40,)))
    with (run_dir / "log.jsonl").open("a") as log:
        for t in (20, 20, 30):
            log.write(json.dumps({"event": "stage", "stage": f"going on from t = {t} s"}) + "\n")
    assert "It was resumed at t = 20 s and t = 30 s." in lead(read_run(run_dir))[0]


def test_lead_marks_the_status_words_and_escapes_the_rest() -> None:
    shown = lead_section(["The bound is proved: <b>, and proved alone."])
    assert 'is <span class="status proved">proved</span>: &lt;b&gt;, and proved alone.' in shown
