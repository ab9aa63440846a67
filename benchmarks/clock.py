"""Alternating timing of two or more functions, so that load on the machine affects all of them alike.

One sample of each is taken a round, in an order that rotates, and ratios are formed round by round:
their median is what is reported, with the smallest and the largest beside it.
"""

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

Sample = Callable[[], float]
"""Takes one sample: the seconds that one call took."""

_SHORTEST = 5e-3
"""A sample spans at least this many seconds: timer and scheduler are then below a percent of it."""
_FEWEST = 3
"""Rounds that a median is taken of at the least."""


@dataclass(frozen=True)
class Spread:
    """The median of repeated measurements, the smallest and the largest."""

    middle: float
    low: float
    high: float


def spread(values: Sequence[float]) -> Spread:
    """**Raises:** `ValueError` for no values at all."""
    if not values:
        raise ValueError("no measurements to take the median of: run at least one round")
    return Spread(statistics.median(values), min(values), max(values))


def ratios(above: Sequence[float], below: Sequence[float]) -> Spread:
    """above / below, round by round."""
    return spread([a / b for a, b in zip(above, below, strict=True)])


def timed(run: Callable[[], object]) -> Sample:
    """A sample of `run`, which returns only when its work is done.

    It is called here twice: once to compile and fill caches, once to see how often a sample repeats
    it.
    """
    run()
    calls = max(1, round(_SHORTEST / max(_seconds(run, 1), 1e-9)))
    return lambda: _seconds(run, calls)


def in_turn(
    samples: Mapping[str, Sample], rounds: int, *, enough: float = math.inf
) -> dict[str, list[float]]:
    """Seconds of every sample in every round: `rounds` of them, or, where they are long, as many as
    begin within `enough` seconds, but three at least."""
    names = list(samples)
    taken: dict[str, list[float]] = {name: [] for name in names}
    started = time.perf_counter()
    for number in range(rounds):
        if number >= _FEWEST and time.perf_counter() - started > enough:
            break
        first = number % len(names)
        for name in names[first:] + names[:first]:
            taken[name].append(samples[name]())
    return taken


def _seconds(run: Callable[[], object], calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        run()
    return (time.perf_counter() - start) / calls
