"""The sentences at the top of a report: what was solved, what is proved, and how large the error is.

They are made of summary.json and manifest.json, as the tables are.
"""

from collections.abc import Collection, Mapping, Sequence

from dvax._figure_text import entry_text
from dvax.app.plots.run_reader import CONTACT, UNFINISHED, RunRecord
from dvax.app.plots.theme import counted, number, unit_text
from dvax.app.runs.state_bound import best_bound, certifies_no_digit, is_finite
from dvax.theory.status import ORDER

# What a run of a model solves; another model is named.
SUBJECTS = {
    CONTACT: "the contact law",
    "circuit": "a circuit with ideal diodes",
    "fem-contact": "the contact of an elastic body with a punch",
    "frame": "a frame under an earthquake",
    "market": "prices on an electricity market",
    "mpc": "a plant under predictive control",
    "thermostat": "the temperature of a heated room",
    "traffic": "day-to-day traffic on a road network",
    "viscoplasticity": "a viscoplastic material point",
}
_RESTS_ON = {
    "proved": "it follows from the structure of the problem, up to roundoff",
    "declared": "it rests on constants that the problem declares",
    "estimated": "it rests on sampled values, not on a proof",
    "refuted": "a counterexample contradicts an assumption",
}


def lead(run: RunRecord) -> list[str]:
    """Return the sentences, in plain text. The status words of the theory stand alone in them."""
    said = [_solved(run), _bounded(run), _well_posed(run)]
    return [text for text in said if text]


def _solved(run: RunRecord) -> str:
    """What was solved, over which time, how it ended."""
    if run.trajectory is None:
        ending = UNFINISHED.get(run.status, "The run ended.")
        return f"{ending} There are no results for {_subject(run)}."
    steps, method = run.manifest.get("steps"), run.manifest.get("method")
    # The method may be followed by the reason for its choice.
    name = f" of {str(method).partition(':')[0]}" if method else ""
    how = f" in {counted(int(steps), 'step')}{name}" if steps else ""
    times = run.saved_times
    saved = "" if times is None else f", with {counted(len(times.values), 'saved time')}"
    text = f"This run solved {_subject(run)}{_size(run)}{_span(run)}{how}{saved}."
    if run.resumed:
        text += f" It was resumed at {' and '.join(run.resumed)}."
    if run.status in UNFINISHED:
        text += f" {UNFINISHED[run.status]} The results are partial."
    return text


def _subject(run: RunRecord) -> str:
    if run.model == "python":
        # The fit names the file that the configuration names, and not its copy.
        words, _, file = str(run.manifest.get("fit") or "a problem of your own").partition(": ")
        return f"{words} ({file})" if file else words
    return SUBJECTS.get(run.model, f"the model {run.model}")


def _size(run: RunRecord) -> str:
    if run.model == CONTACT:
        points = " × ".join(number(n) for n in run.boundary_shape)
        return f" at {points} points of the boundary"
    sizes = [
        counted(int(run.manifest[f"{noun}s"]), noun)
        for noun in ("state", "response")
        if f"{noun}s" in run.manifest
    ]
    return f" with {' and '.join(sizes)}" if sizes else ""


def _span(run: RunRecord) -> str:
    times = run.saved_times
    if times is None or not len(times.values):
        return ""
    unit, end = unit_text(times.unit), run.config.get("time", {}).get("end")
    last = float(times.values[-1])
    aim = f" (of {number(float(end))})" if isinstance(end, int | float) and end > last else ""
    return f" from {number(float(times.values[0]))} to {number(last)}{aim} {unit}".rstrip()


def _bounded(run: RunRecord) -> str:
    """The error bound, how much is known of it, and its ratio to the size of the solution."""
    entry = best_bound(run.summary)
    if run.trajectory is None:
        return ""
    if entry is None:
        return "No error bound was computed." if run.summary else ""
    status = str(entry["bound"])
    if status not in _RESTS_ON:
        return f"The error bound is {status}: this method keeps no data to compute it from."
    if not is_finite(entry):
        why = f": {entry['why']}" if "why" in entry else ""
        return f"The error bound is not finite, so it states nothing about the error{why}."
    meaning = str(entry.get("meaning", "")).removesuffix(f" ({status})")
    amount = f"{entry_text(entry)} {unit_text(str(entry.get('unit', '')))}".strip()
    text = f"The error bound is {status}: {amount}"
    relative = entry.get("relative")
    if certifies_no_digit(entry):
        text += ", more than the norm of the solution, so that it certifies no digit"
    elif isinstance(relative, int | float):
        share = entry_text({"value": float(relative), "bound": status}).removeprefix("≤ ")
        text += f", at most {share} of the norm of the solution"
    return f"{text} ({meaning}; {_RESTS_ON[status]})."


def _well_posed(run: RunRecord) -> str:
    """What is known of the assumptions, or of the constants where the run lists no assumptions."""
    gamma = next((row.value for row in run.constants if row.name == "gamma"), None)
    if isinstance(gamma, int | float) and not gamma > 0:
        return f"Well-posedness is not shown: γ = {number(gamma)} is not positive."
    rows = [row for row in run.assumptions if row.is_required]
    if any(row.status == "refuted" for row in rows):
        # A sufficient condition that fails does not refute what follows from it; the reason is stated.
        failing = "; ".join(f"{r.statement} ({r.why})" for r in rows if r.status == "refuted")
        others = {row.label: row.status for row in rows if row.status != "refuted"}
        rest = f" For the others, {_tally(others, 'needed assumption')}" if others else ""
        return f"An assumption of well-posedness is refuted: {failing}.{rest}{_fit(run)}"
    statuses, noun = {row.label: row.status for row in rows}, "needed assumption"
    if not rows:
        statuses, noun = {row.name: row.status for row in run.constants}, "constant"
    if not statuses:
        return ""
    return f"{_verdict(statuses.values())} {_tally(statuses, noun)}{_fit(run)}"


def _verdict(statuses: Collection[str]) -> str:
    """The weakest status; a word that is none of the four says nothing."""
    weakest = max(statuses, key=ORDER.index) if set(statuses) <= set(ORDER) else "not known"
    return f"Well-posedness is {weakest}:"


def _tally(statuses: Mapping[str, str], noun: str) -> str:
    """Return how many have which status; those that are not proved are named where they are few."""
    groups: dict[str, list[str]] = {}
    for label, status in statuses.items():
        groups.setdefault(status, []).append(label)
    if set(groups) == {"proved"}:
        return f"all {counted(len(statuses), noun)} are proved."
    parts = [
        f"{len(groups[status])} {'is' if len(groups[status]) == 1 else 'are'} {status}"
        + _named(status, groups[status])
        for status in (*ORDER, *sorted(set(groups) - set(ORDER)))
        if status in groups
    ]
    return f"of {counted(len(statuses), noun)} {', '.join(parts)}."


def _named(status: str, labels: Sequence[str]) -> str:
    return "" if status == "proved" or len(labels) > 3 else f" ({', '.join(labels)})"


def _fit(run: RunRecord) -> str:
    fit = str(run.manifest.get("fit") or "")
    if not fit or run.model == "python":
        return ""
    return " The model is in the class exactly." if fit == "exact" else f" The model: {fit}."
