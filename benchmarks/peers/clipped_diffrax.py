"""The contact law in Diffrax, the clip written into the vector field."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp

from ..contact_law import ContactLaw

_MOST_STEPS = 2**16


def solver(
    law: ContactLaw, method: diffrax.AbstractAdaptiveSolver, t1: float
) -> Callable[[float], Any]:
    """rtol -> x(t1) under jax.jit, with atol a thousandth of rtol and the end saved alone.

    The parameters and the tolerance are arguments of the compiled function, as in dvax.
    """
    names = ("alpha", "b_x", "b_u", "d_x", "d_u", "ell")
    given = {name: jnp.asarray(getattr(law, name)) for name in names}
    given |= {"capacity": jnp.asarray(law.capacity), "g": jnp.asarray(law.model.g(0.0))}

    def field(t: Any, x: Any, p: dict[str, Any]) -> Any:
        u = jnp.clip((p["g"] - p["b_x"] * x) / (1.0 + p["b_u"]), 0.0, p["capacity"])
        return p["ell"] - (p["alpha"] + p["d_x"]) * x - p["d_u"] * u

    @jax.jit
    def solve(p: dict[str, Any], x0: Any, rtol: Any) -> Any:
        answer = diffrax.diffeqsolve(
            diffrax.ODETerm(field), method, 0.0, t1, None, x0, p,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-3 * rtol),
            saveat=diffrax.SaveAt(t1=True), max_steps=_MOST_STEPS,
        )  # fmt: skip
        assert answer.ys is not None
        return answer.ys[-1]

    start = jnp.asarray(law.start)
    return lambda rtol: jax.block_until_ready(solve(given, start, rtol))
