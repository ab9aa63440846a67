"""The tables on stability: the status of each assumption, and the terms of the certified rate."""

from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.tables import escaped, status_mark, table
from dvax.app.plots.theme import quantity


def assumptions_table(run: RunRecord) -> str:
    """Each assumption of the theory with its status and how that is known; nothing for older runs."""
    rows = [
        (
            f"<code>{escaped(row.label)}</code>",
            escaped(row.statement),
            status_mark(row.status),
            escaped(row.why),
        )
        for row in run.assumptions
    ]
    return table(("assumption", "what it says", "status", "how it is known"), rows) if rows else ""


def losses_table(run: RunRecord) -> str:
    """The terms of the certified rate of separation, beside the one-sided rate: the largest term is
    the one to improve."""
    known = {row.name: row for row in run.constants}
    needed = ("omega", "M", "alpha_f", "beta_f", "L", "growth_rate")
    if not all(n in known and isinstance(known[n].value, int | float) for n in needed):
        return ""
    value = {name: float(known[name].value) for name in needed}
    unit = known["growth_rate"].unit
    terms = [
        ("growth of the semigroup", "ω", value["omega"]),
        ("f in the state", "M α_f", value["M"] * value["alpha_f"]),
        ("f in the response", "M β_f L", value["M"] * value["beta_f"] * value["L"]),
    ]
    largest = max(terms[1:], key=lambda term: term[2])
    rows = [
        _line(
            words,
            symbol,
            number,
            unit,
            "the largest term" if (words, symbol, number) == largest else "",
        )
        for words, symbol, number in terms
    ]
    rows.append(
        _line("all together", "ω + M L̃", value["growth_rate"], unit, _word(value["growth_rate"]))
    )
    sharp = known.get("sharp_decay_rate")
    if sharp is not None:
        mu = -float(sharp.value)
        rows.append(_line("with signs", "μ", mu, unit, _word(mu)))
        rows.append(
            _line("lost to absolute values", "ω + M L̃ − μ", value["growth_rate"] - mu, unit, "")
        )
    return table(("part of the rate", "symbol", "value", "remark"), rows)


def _word(rate: float) -> str:
    if rate == 0:
        return "their distance stays bounded"
    return "trajectories approach" if rate < 0 else "trajectories may separate"


def _line(words: str, symbol: str, number: float, unit: str, remark: str) -> tuple[str, ...]:
    return escaped(words), escaped(symbol), escaped(quantity(number, unit)), escaped(remark)
