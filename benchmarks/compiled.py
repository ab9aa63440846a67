"""`dvax.solve` as programs call it: directly, and within a function under jax.jit."""

from collections.abc import Callable
from typing import Any

import jax

import dvax

from .contact_law import ContactLaw


def called(model: dvax.models.Contact, x0: Any, t1: float, **settings: Any) -> Any:
    """x(t1) from a plain call, which checks its arguments and builds a whole `Solution`."""
    return jax.block_until_ready(dvax.solve(model.problem, x0, 0.0, t1, **settings).xs)[-1]


def fixed(t1: float, most: int) -> Callable[[Any, Any, Any], Any]:
    """(model, x0, dt) -> x(t1) under jax.jit, with up to `most` steps; parameters are arguments."""

    @jax.jit
    def solve(model: dvax.models.Contact, x0: Any, dt: Any) -> Any:
        return dvax.solve(model.problem, x0, 0.0, t1, dt=dt, max_steps=most).xs[-1]

    return lambda model, x0, dt: jax.block_until_ready(solve(model, x0, dt))


def adaptive(t1: float, method: Any = None) -> Callable[[Any, Any, Any, Any], Any]:
    """(model, x0, rtol, atol) -> x(t1) under jax.jit; parameters are arguments."""

    @jax.jit
    def solve(model: dvax.models.Contact, x0: Any, rtol: Any, atol: Any) -> Any:
        return dvax.solve(model.problem, x0, 0.0, t1, rtol=rtol, atol=atol, method=method).xs[-1]

    return lambda model, x0, rtol, atol: jax.block_until_ready(solve(model, x0, rtol, atol))


def known(law: ContactLaw, t1: float, dt: float) -> Callable[[Any, Any], Any]:
    """(g, x0) -> x(t1) under jax.jit in fixed steps, every number known to the compiler."""
    letters = ("alpha", "beta", "b_x", "b_u", "d_x", "d_u", "kappa0", "ell")
    numbers = {name: getattr(law, name) for name in letters}

    @jax.jit
    def solve(g: Any, x0: Any) -> Any:
        model = dvax.models.Contact(**numbers, g=g)
        return dvax.solve(model.problem, x0, 0.0, t1, dt=dt).xs[-1]

    return lambda g, x0: jax.block_until_ready(solve(g, x0))
