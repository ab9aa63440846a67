"""Against Siconos in its fastest layout for the contact law, per step and at equal error."""

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from .. import compiled
from ..clock import Sample, timed
from ..contact_law import ContactLaw, strip
from ..peers.siconos_client import Siconos, python
from ..section import Section, compare

_STEP = 1e-3
_CANDIDATES = sorted({round(2 ** (k / 4)) for k in range(41)})
"""Numbers of steps among which the fewest that suffice are sought, up to 1 024."""
_LEAST = {1: 200.0, 1000: 5000.0}


def run(full: bool) -> Section:
    section = Section(
        title=f"siconos: the contact law, h = {_STEP:g}, against Siconos",
        fair=(
            "Siconos: relay one-step problem by projected Gauss-Seidel (tolerance 1e-12), a system "
            "and an interaction a point, which of its layouts and solvers is the fastest for this "
            "law; only its stepping is timed, not its set-up; its own loop in C++, "
            "TimeStepping.run, was no more than 15 % faster. Its state is compared with the closed "
            "form at the end, since a success that it reports may hide NaN. dvax is timed as "
            "called (arguments checked, a Solution returned) and under jax.jit with parameters, x0 "
            "and dt as arguments. 'Same step' has both at h; 'same error' gives dvax the fewest "
            "steps with which its error is not above that of Siconos, with all finer ones that "
            "were tried below it as well; the targets are on these. Times are those of the whole "
            "run."
        ),
    )
    interpreter = python()
    if interpreter is None:
        section.skipped = (
            "no Python here imports siconos.kernel; on Debian install python3-siconos, which "
            "serves the system's Python"
        )
        return section
    with Siconos(interpreter) as siconos:
        for points, end in ((1, 2.0), (1000, 1.0 if full else 0.3)):
            for theta in (1.0, 0.5):
                _compare(section, siconos, strip(points), end, theta, 21 if full else 9)
        printed = siconos.said()
    if printed:
        section.notes.append(f"Siconos printed: {printed.splitlines()[0]}")
    if not full:
        section.notes.append("1000 points run to t = 0.3 here, and to t = 1 with --full.")
    return section


def _compare(
    section: Section, siconos: Siconos, law: ContactLaw, end: float, theta: float, rounds: int
) -> None:
    steps = round(end / _STEP)
    start = jnp.asarray(law.start)
    at_h = compiled.fixed(end, 2 * steps)
    coarse = compiled.fixed(end, 2 * _CANDIDATES[-1])

    sampled, finish = _siconos_samples(siconos, law, end, theta, steps, rounds)
    error_other = finish()
    fewest, error_fewest = _fewest_steps(law, end, coarse, error_other)
    error_h = law.error(at_h(law.model, start, _STEP), end)

    jitted = timed(functools.partial(at_h, law.model, start, _STEP))
    jitted_few = timed(functools.partial(coarse, law.model, start, end / fewest))
    plain = timed(functools.partial(compiled.called, law.model, start, end, dt=_STEP))
    plain_few = timed(functools.partial(compiled.called, law.model, start, end, dt=end / fewest))
    ours: dict[tuple[str, str], Sample] = {
        ("same step", "jax.jit"): jitted,
        ("same step", "as called"): plain,
        (f"same error, {fewest} steps", "jax.jit"): jitted_few,
        (f"same error, {fewest} steps", "as called"): plain_few,
    }
    taken: dict[tuple[str, str], list[float]] = {key: [] for key in ours}
    other = []
    for _ in range(rounds):
        other.append(sampled())
        for key, sample in ours.items():
            taken[key].append(sample())

    n = law.g.size
    for (what, way), series in taken.items():
        section.comparisons.append(
            compare(
                f"n = {n}, {what}, {way}",
                f"Siconos θ = {theta:g}, {steps} steps",
                series,
                other,
                direction="other/dvax",
                error=error_h if what == "same step" else error_fewest,
                error_other=error_other,
                target=None if what == "same step" else ("≥", _LEAST[n]),
            )
        )


def _siconos_samples(
    siconos: Siconos, law: ContactLaw, end: float, theta: float, steps: int, rounds: int
) -> tuple[Sample, Callable[[], float]]:
    """(seconds of a whole run per sample, the error at its end).

    One point: every sample is a whole run. A thousand: a sample is a share of the steps of one run,
    scaled to all of them.
    """

    def error() -> float:
        siconos.build(law, _STEP, theta, end)
        siconos.advance(steps)
        return law.error(siconos.state(), end)

    share = steps if law.g.size == 1 else max(1, steps // rounds)

    def sample() -> float:
        if share == steps:
            siconos.build(law, _STEP, theta, end)
        elif not progress or progress[-1] + share > steps:
            siconos.build(law, _STEP, theta, end)
            progress.append(0)
        if progress:
            progress[-1] += share
        return siconos.advance(share) * steps / share

    progress: list[int] = []
    return sample, error


def _fewest_steps(
    law: ContactLaw, end: float, solve: Callable[[Any, Any, Any], Any], allowed: float
) -> tuple[int, float]:
    """The fewest steps whose error, like that of every larger number tried, is at most `allowed`.

    **Raises:** `RuntimeError` where the largest number tried does not reach it.
    """
    start = jnp.asarray(law.start)
    best: tuple[int, float] | None = None
    for count in reversed(_CANDIDATES):
        error = law.error(solve(law.model, start, end / count), end)
        if error > allowed:
            break
        best = (count, error)
    if best is None:
        raise RuntimeError(
            f"{_CANDIDATES[-1]} steps of ETD2RK do not reach the error {allowed:g} of the peer: "
            "extend _CANDIDATES"
        )
    return best
