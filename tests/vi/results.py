"""Summaries of the results of a batch of solves."""

from collections import Counter

import numpy as np

from dvax.vi import RESULTS

FAILURES = (
    "max_steps", "stalled", "cycling", "diverging", "nonfinite", "no_bracket", "wrong_slope",
    "not_lipschitz",
)  # fmt: skip


def successful(vi):
    return np.asarray(vi.result == RESULTS.successful)


def reasons(vi, lanes):
    """The failures among `lanes`, by name, one per lane."""
    said = {name: np.asarray(vi.result == getattr(RESULTS, name)) & lanes for name in FAILURES}
    count = Counter({name: int(word.sum()) for name, word in said.items() if word.any()})
    assert count.total() == int(np.sum(lanes & ~successful(vi)))
    return dict(count)
