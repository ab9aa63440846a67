"""The minimal hand-written program: one `lax.fori_loop` with ETD2RK and the clip in its body.

    u(x) = clip(β (g − b_x x)/(1 + b_u), 0, κ₀)/β,      f̃(x) = ℓ − d_x x − d_u u(x)
    a = e^z x + hφ₁(z) f̃(x),      x ← a + hφ₂(z) (f̃(a) − f̃(x)),      z = −αh

It saves states in `saved` only, has no statistics and no check for NaN, and its loop count is given.
The reverse mode uses a `lax.scan` that keeps all states, since a `fori_loop` with an unknown count has
no reverse mode.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..contact_law import ContactLaw

_TERMS = 18
"""Of the series of φ₂; with |z| ≤ 1 the rest is below rounding."""


class Numbers(NamedTuple):
    """Everything a step multiplies or adds that is one number."""

    flow: Any
    first: Any
    second: Any
    gain: Any
    b_x: Any
    kappa0: Any
    d_x: Any
    d_u_by_beta: Any
    ell: Any


def numbers(law: ContactLaw, h: float) -> Numbers:
    """**Raises:** `ValueError` for a step with αh > 1, beyond the series of φ₂."""
    z = -law.alpha * h
    if abs(z) > 1.0:
        raise ValueError(f"alpha h = {-z:g} must be at most 1: the series of phi_2 is cut for it")
    phi_1 = math.expm1(z) / z
    phi_2 = sum(z**k / math.factorial(k + 2) for k in range(_TERMS))
    return Numbers(
        math.exp(z), h * phi_1, h * phi_2, law.beta / (1.0 + law.b_u), law.b_x, law.kappa0,
        law.d_x, law.d_u / law.beta, law.ell,
    )  # fmt: skip


def as_arguments(law: ContactLaw, h: float) -> Callable[[Any, int], Any]:
    """(x0, steps) -> x, where the numbers are arguments of the compiled loop, as in dvax."""
    given, g = _arrays(law, h)
    loop = jax.jit(_loop)
    return lambda x0, steps: jax.block_until_ready(loop(given, g, x0, steps))


def as_constants(law: ContactLaw, h: float) -> Callable[[Any, int], Any]:
    """(x0, steps) -> x, where the numbers are known to the compiler."""
    given = numbers(law, h)
    loop = jax.jit(lambda g, x0, steps: _loop(given, g, x0, steps))
    g = jnp.asarray(law.g.reshape(law.start.shape))
    return lambda x0, steps: jax.block_until_ready(loop(g, x0, steps))


def saved(law: ContactLaw, h: float, steps: int) -> Callable[[Any], Any]:
    """x0 -> the states before and after every step, by a scan."""
    given, g = _arrays(law, h)

    @jax.jit
    def states(given: Numbers, g: Any, x0: Any) -> Any:
        step = _step(given, g)

        def turn(x: Any, _: Any) -> tuple[Any, Any]:
            return step(x), x

        last, before = lax.scan(turn, x0, length=steps)
        return jnp.concatenate([before, last[None]])

    return lambda x0: jax.block_until_ready(states(given, g, x0))


def gradient(law: ContactLaw, h: float, steps: int) -> Callable[[Any], dict[str, Any]]:
    """x0 -> the derivatives of Σx with respect to b_x, d_x and ℓ, by jax.grad through a scan."""
    letters = ("b_x", "d_x", "ell")
    given, g = _arrays(law, h)

    @jax.jit
    @jax.grad
    def slope(moving: dict[str, Any], fixed: Numbers, g: Any, x0: Any) -> Any:
        step = _step(fixed._replace(**moving), g)
        return jnp.sum(lax.scan(lambda x, _: (step(x), None), x0, length=steps)[0])

    at = {name: getattr(given, name) for name in letters}
    return lambda x0: jax.block_until_ready(slope(at, given, g, x0))


def gradient_by_start(law: ContactLaw, h: float, steps: int) -> Callable[[Any], Any]:
    """x0 -> the derivative of Σx with respect to x0, by jax.grad through a scan."""
    given, g = _arrays(law, h)

    @jax.jit
    @jax.grad
    def slope(x0: Any, given: Numbers, g: Any) -> Any:
        step = _step(given, g)
        return jnp.sum(lax.scan(lambda x, _: (step(x), None), x0, length=steps)[0])

    return lambda x0: jax.block_until_ready(slope(x0, given, g))


def tangent(law: ContactLaw, h: float, steps: int) -> Callable[[Any], Any]:
    """x0 -> the derivative of Σx with respect to ℓ, by jax.jvp of the loop."""
    given, g = _arrays(law, h)

    @jax.jit
    def along(given: Numbers, g: Any, x0: Any) -> Any:
        end = lambda ell: jnp.sum(_loop(given._replace(ell=ell), g, x0, steps))  # noqa: E731
        return jax.jvp(end, (given.ell,), (jnp.ones_like(given.ell),))[1]

    return lambda x0: jax.block_until_ready(along(given, g, x0))


def _arrays(law: ContactLaw, h: float) -> tuple[Numbers, jax.Array]:
    g = jnp.asarray(law.g.reshape(law.start.shape))
    return Numbers(*map(jnp.asarray, numbers(law, h))), g


def _loop(n: Numbers, g: jax.Array, x0: jax.Array, steps: Any) -> jax.Array:
    step = _step(n, g)
    return lax.fori_loop(0, steps, lambda _, x: step(x), x0)


def _step(n: Numbers, g: jax.Array) -> Callable[[jax.Array], jax.Array]:
    def rate(x: jax.Array) -> jax.Array:
        pressure = jnp.clip(n.gain * (g - n.b_x * x), 0.0, n.kappa0)
        return n.ell - n.d_x * x - n.d_u_by_beta * pressure

    def step(x: jax.Array) -> jax.Array:
        before = rate(x)
        a = n.flow * x + n.first * before
        return a + n.second * (rate(a) - before)

    return step
