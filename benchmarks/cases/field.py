"""Fixed steps on a field of 10⁶ points against a loop written by hand."""

import functools

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
_SHORT_RUN_STEPS = 20
_TARGET_RATIO = 1.25
_CALLED, _CONSTANTS = "dvax.solve as called", "dvax.solve under jax.jit, parameters as constants"
_HAND, _HAND_CONSTANTS = "hand-fused, arguments", "hand-fused, constants"


def run(full: bool) -> Section:
    steps, rounds = (500, 15) if full else (200, 9)
    law = strip(_POINTS)
    start, g = jnp.asarray(law.start), jnp.asarray(law.g)
    by_hand = hand_fused.as_arguments(law, _STEP), hand_fused.as_constants(law, _STEP)

    def sides(count: int) -> dict[str, functools.partial]:
        known = compiled.known(law, count * _STEP, _STEP)
        return {
            _CALLED: functools.partial(compiled.called, law.model, start, count * _STEP, dt=_STEP),
            _CONSTANTS: functools.partial(known, g, start),
            _HAND: functools.partial(by_hand[0], start, count),
            _HAND_CONSTANTS: functools.partial(by_hand[1], start, count),
        }

    long, short = sides(steps), sides(_SHORT_RUN_STEPS)
    errors = {name: law.error(side(), steps * _STEP) for name, side in long.items()}
    samples = {f"{name} {steps}": timed(side) for name, side in long.items()}
    samples |= {f"{name} {_SHORT_RUN_STEPS}": timed(side) for name, side in short.items()}
    taken = in_turn(samples, rounds)

    def per_step(name: str) -> list[float]:
        """Seconds per point and step, the start-up taken out by the shorter run."""
        pairs = zip(taken[f"{name} {steps}"], taken[f"{name} {_SHORT_RUN_STEPS}"])
        return [(more - less) / (steps - _SHORT_RUN_STEPS) / _POINTS for more, less in pairs]

    section = Section(
        title=f"field: {_POINTS:.0e} contact points, {steps} fixed steps of ETD2RK",
        fair=(
            "The other side is one lax.fori_loop with the same ETD2RK arithmetic and the clip in "
            "its body: no saving, no statistics, no look for NaN. 'arguments': the parameters and "
            "the φ-factors are run-time arguments of the compiled loop, as they are in dvax.solve "
            "as called. 'constants': the compiler knows them and may fold them, on the dvax side "
            "too where that row says so. All read the demand g, a number a point, from memory. "
            "dvax.solve as called returns a whole Solution; under jax.jit the unused parts of it "
            "are not computed. Errors: against the closed form at the last time."
        ),
    )
    for ours, other, target in (
        (_CALLED, _HAND, _TARGET_RATIO),
        (_CONSTANTS, _HAND_CONSTANTS, _TARGET_RATIO),
        (_CALLED, _HAND_CONSTANTS, None),
    ):
        section.comparisons.append(
            compare(
                f"whole run, {ours}",
                other,
                taken[f"{ours} {steps}"],
                taken[f"{other} {steps}"],
                error=errors[ours],
                error_other=errors[other],
                target=None if target is None else ("≤", target),
            )
        )
        section.comparisons.append(
            compare(f"per point and step, {ours}", other, per_step(ours), per_step(other))
        )
    for name in (_CALLED, _CONSTANTS):
        each = spread(per_step(name)).middle * _POINTS
        rest = spread(
            [seconds - _SHORT_RUN_STEPS * each for seconds in taken[f"{name} {_SHORT_RUN_STEPS}"]]
        ).middle
        section.notes.append(f"Start-up of {name}: {duration(max(rest, 0.0))} a run.")
    section.notes.append(
        f"Start-up is the time of {_SHORT_RUN_STEPS} steps minus {_SHORT_RUN_STEPS} times the cost of "
        "a step. In a call it is the checks, the response and its certificate at the saved time, and "
        "the copies that the Solution holds. 'per point and step' is without it."
    )
    section.notes.append(f"JAX runs on {jax.devices()[0].device_kind}.")
    return section
