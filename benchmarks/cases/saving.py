"""The cost of saving every step."""

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..clock import in_turn, timed
from ..contact_law import strip
from ..peers import hand_fused
from ..section import Section, compare

_END, _STEPS = 2.0, 1000
_BOTH, _STATES, _LAST, _HAND = "states and responses", "states", "the last alone", "states, by hand"


def run(full: bool) -> Section:
    section = Section(
        title=f"saving: every one of {_STEPS} fixed steps",
        fair=(
            "All under jax.jit, the same steps. 'the last alone' is dvax.solve without ts, state and "
            "response. 'states, by hand' is a lax.scan of the same arithmetic that returns its states, "
            "parameters as arguments. Errors: x(2) against the closed form."
        ),
    )
    every, h = jnp.linspace(0.0, _END, _STEPS + 1), _END / _STEPS
    for points in (2, 100, 10**3, 10**4):
        law = strip(points)
        problem, start = law.model.problem, jnp.asarray(law.start)

        def solved(x0, ts, problem=problem):
            found = dvax.solve(problem, x0, 0.0, _END, ts=ts, dt=h)
            return found.xs, found.us

        by_hand = hand_fused.saved(law, h, _STEPS)
        programs = {
            _BOTH: jax.jit(lambda x, solved=solved: solved(x, every)),
            _STATES: jax.jit(lambda x, solved=solved: solved(x, every)[:1]),
            _LAST: jax.jit(lambda x, solved=solved: solved(x, None)),
            _HAND: lambda x, by_hand=by_hand: (by_hand(x),),
        }
        sides = {
            name: lambda run=run, x=start: jax.block_until_ready(run(x))
            for name, run in programs.items()
        }
        errors = {name: law.error(np.asarray(side()[0][-1]), _END) for name, side in sides.items()}
        taken = in_turn({n: timed(s) for n, s in sides.items()}, 31 if full else 15)
        for ours, other in ((_BOTH, _LAST), (_STATES, _LAST), (_STATES, _HAND)):
            section.comparisons.append(
                compare(f"n = {points}, {ours}", other, taken[ours], taken[other],
                        error=errors[ours], error_other=errors[other],
                        target=("≤", 2.0) if other == _LAST else None)
            )  # fmt: skip
    return section
