"""Fixed steps at a single point: the cost of the time loop itself."""

import jax.numpy as jnp

from .. import compiled
from ..clock import in_turn, spread, timed
from ..contact_law import single
from ..layout import duration
from ..peers import hand_fused
from ..section import Comparison, Section, Target, compare

_END = 2.0
_STEPS = 10**5
_NANOSECONDS = 100.0


def run(full: bool) -> Section:
    rounds = 31 if full else 15
    law = single()
    dt = _END / _STEPS
    start = jnp.asarray(law.start)
    jitted = compiled.fixed(_END, 2**17)
    loops = {
        "hand-fused loop, parameters as arguments": hand_fused.as_arguments(law, dt),
        "hand-fused loop, parameters as constants": hand_fused.as_constants(law, dt),
    }
    sides = {
        "called": lambda: compiled.called(law.model, start, _END, dt=dt),
        "jitted": lambda: jitted(law.model, start, dt),
        **{name: lambda loop=loop: loop(start, _STEPS) for name, loop in loops.items()},
    }
    errors = {name: law.error(side(), _END) for name, side in sides.items()}
    taken = {
        name: [seconds / _STEPS for seconds in series]
        for name, series in in_turn({n: timed(s) for n, s in sides.items()}, rounds).items()
    }
    section = Section(
        title=f"point: one contact point (C1), {_STEPS:.0e} fixed steps",
        fair=(
            "Time a step, the whole call divided by its steps. The target is absolute. The "
            "hand-fused loop is the same arithmetic without times, results or checks, so it shows "
            "what the loop around a step costs. Errors: against the closed form at t = 2."
        ),
    )
    for way, name in (("dvax.solve as called", "called"), ("dvax.solve under jax.jit", "jitted")):
        middle = spread(taken[name]).middle
        section.comparisons.append(
            Comparison(
                case=f"a step, {way}",
                versus="-",
                dvax=middle,
                other=None,
                error=errors[name],
                target=Target("≤", _NANOSECONDS, middle / 1e-9, " ns"),
                rounds=rounds,
            )
        )
    for name in loops:
        section.comparisons.append(
            compare("a step, dvax.solve as called", name, taken["called"], taken[name],
                    error=errors["called"], error_other=errors[name])
        )  # fmt: skip
    fastest = min(taken["called"])
    section.notes.append(f"The fastest sample of dvax.solve as called: {duration(fastest)} a step.")
    return section
