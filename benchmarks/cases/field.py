"""Fixed steps on a field of 10⁶ points against a loop written by hand."""

import jax
import jax.numpy as jnp

from .. import compiled
from ..clock import in_turn, spread, timed
from ..contact_law import strip
from ..layout import duration
from ..peers import hand_fused
from ..section import Section, compare

_POINTS = 10**6
_STEP = 1e-3
_FEW = 20
_MOST_OF_THE_COST = 1.25


def run(full: bool) -> Section:
    steps, rounds = (1000, 15) if full else (200, 9)
    law = strip(_POINTS)
    start = jnp.asarray(law.start)
    hand = {
        "parameters as arguments": hand_fused.as_arguments(law, _STEP),
        "parameters as constants": hand_fused.as_constants(law, _STEP),
    }
    ends: dict[str, jax.Array] = {"dvax": compiled.called(law.model, start, steps * _STEP, dt=_STEP)}
    ends |= {name: loop(start, steps) for name, loop in hand.items()}
    errors = {name: law.error(x, steps * _STEP) for name, x in ends.items()}
    del ends

    samples = {}
    for count in (_FEW, steps):
        samples[f"dvax {count}"] = timed(
            lambda count=count: compiled.called(law.model, start, count * _STEP, dt=_STEP)
        )
        for name, loop in hand.items():
            samples[f"{name} {count}"] = timed(lambda loop=loop, count=count: loop(start, count))
    taken = in_turn(samples, rounds)

    def per_step(who: str) -> list[float]:
        """Seconds per point and step, the start-up taken out by the shorter run."""
        pairs = zip(taken[f"{who} {steps}"], taken[f"{who} {_FEW}"])
        return [(long - short) / (steps - _FEW) / _POINTS for long, short in pairs]

    section = Section(
        title=f"field: {_POINTS:.0e} contact points, {steps} fixed steps of ETD2RK",
        fair=(
            "The other side is one lax.fori_loop with the same ETD2RK arithmetic and the clip in its "
            "body: no saving, no statistics, no look for NaN. It is timed twice: with the seven "
            "parameters and the φ-factors as run-time arguments, as dvax has them, and with all of "
            "them as constants that the compiler may fold. Both read the demand g, a number a "
            "point, from memory, and so does dvax. dvax is called as a user calls it, and returns a "
            "whole Solution. Errors: against the closed form at the last time."
        ),
    )
    for name in hand:
        section.comparisons.append(
            compare(
                f"whole call, {steps} steps",
                f"hand-fused loop, {name}",
                taken[f"dvax {steps}"],
                taken[f"{name} {steps}"],
                error=errors["dvax"],
                error_other=errors[name],
                target=("≤", _MOST_OF_THE_COST),
            )
        )
    for name in hand:
        section.comparisons.append(
            compare(
                "per point and step, without start-up",
                f"hand-fused loop, {name}",
                per_step("dvax"),
                per_step(name),
            )
        )
    each = spread(per_step("dvax")).middle * _POINTS
    rest = spread([short - _FEW * each for short in taken[f"dvax {_FEW}"]]).middle
    section.notes.append(
        f"Start-up of dvax: {duration(max(rest, 0.0))} a call (what {_FEW} steps take beyond "
        f"{_FEW} times the cost of a step): checks, responses and certificate at the saved time, and "
        "the fields of the Solution, each an array of its own."
    )
    return section
