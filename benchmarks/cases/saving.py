"""What it costs to save every step."""

import jax
import jax.numpy as jnp

import dvax

from ..clock import in_turn, timed
from ..contact_law import strip
from ..section import Section, compare

_END, _STEPS = 2.0, 1000


def run(full: bool) -> Section:
    section = Section(
        title=f"saving: the states and responses of {_STEPS} fixed steps",
        fair=(
            "Both under jax.jit, the same steps. The other side saves the last state alone. Errors: "
            "x(2) against the closed form."
        ),
    )
    every = jnp.linspace(0.0, _END, _STEPS + 1)
    for points in (2, 10**3):
        law = strip(points)
        problem, start = law.model.problem, jnp.asarray(law.start)

        def saved(x0, ts, problem=problem):
            found = dvax.solve(problem, x0, 0.0, _END, ts=ts, dt=_END / _STEPS)
            return found.xs, found.us

        run_every, run_last = jax.jit(lambda x: saved(x, every)), jax.jit(lambda x: saved(x, None))
        sides = {
            "every": lambda run=run_every, x=start: jax.block_until_ready(run(x)),
            "last": lambda run=run_last, x=start: jax.block_until_ready(run(x)),
        }
        errors = {name: law.error(side()[0][-1], _END) for name, side in sides.items()}
        taken = in_turn({n: timed(s) for n, s in sides.items()}, 31 if full else 15)
        section.comparisons.append(
            compare(f"n = {points}, every step", "the last alone", taken["every"], taken["last"],
                    error=errors["every"], error_other=errors["last"], target=("≤", 2.0))
        )  # fmt: skip
    return section
