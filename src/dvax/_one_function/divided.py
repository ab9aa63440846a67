"""Loops that call libraries: what lies between those calls as few functions of the processor.

A loop whose turns call a library (a Fourier transform) cannot be one function. XLA runs such a turn as
a list of some hundred kernels and hands them from thread to thread, which takes longer than their
arithmetic. Here a turn becomes

    function, call, function, call, …, function,

each of which computes all that follows from the calls before it (`turn`).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from .._jaxpr import bound, walked
from .small import CALLS, called, inner_programs, is_brief, is_known
from .turn import Turn
from .within import retraced


def can_divide(program: ClosedJaxpr) -> bool:
    """Whether there is a loop to divide, of turns all of which is small: then to call their kernels is
    what takes time."""
    return not program.effects and any(map(_has_such, program.jaxpr.eqns))


def _has_such(eqn: Any) -> bool:
    name = eqn.primitive.name
    if (name not in CALLS and name != "while") or is_known(eqn):
        return False
    if name == "while" and is_brief(eqn.params["body_jaxpr"]):
        return True
    return any(any(map(_has_such, inner.jaxpr.eqns)) for inner in inner_programs(eqn.params))


def divided(program: ClosedJaxpr) -> ClosedJaxpr:
    """The program with its calls opened and its loops divided."""
    return retraced(lambda *given: walked(program, given, _taken), program.in_avals)


def _taken(eqn: Any, given: list[Any]) -> list[Any]:
    if eqn.primitive.name in CALLS:
        return walked(called(eqn), given, _taken)
    if eqn.primitive.name == "while" and not is_known(eqn):
        return _loop(eqn, given)
    return bound(eqn, given)


def _loop(eqn: Any, given: list[Any]) -> list[Any]:
    first = eqn.params["cond_nconsts"]
    second = first + eqn.params["body_nconsts"]
    of_cond, of_body, init = given[:first], given[first:second], given[second:]
    goes_on, body = jaxpr_as_fun(eqn.params["cond_jaxpr"]), eqn.params["body_jaxpr"]
    if eqn.params["cond_jaxpr"].out_avals[0].shape:
        goes_on, body = _of_batch(goes_on, body, of_cond)
        of_body = of_cond + of_body
    brief = is_brief(body)
    body = divided(body)
    if not brief:
        return lax.while_loop(
            lambda carry: goes_on(*of_cond, *carry)[0],
            lambda carry: jaxpr_as_fun(body)(*of_body, *carry),
            init,
        )
    turn = Turn(body, of_body, init)
    end = lax.while_loop(
        lambda carry: goes_on(*of_cond, *turn.apart(*carry))[0],
        lambda carry: turn(*carry),
        turn.together(init),
    )
    return turn.apart(*end)


def _of_batch(
    goes_on: Callable[..., Any], body: ClosedJaxpr, of_cond: list[Any]
) -> tuple[Callable[..., Any], ClosedJaxpr]:
    """The same loop where each problem of a batch has its own end: it goes on while any of them does,
    and the others stay as they are."""
    first, second = len(of_cond), len(body.in_avals) - len(body.out_avals)

    def turn(*given: Any) -> list[Any]:
        of_cond, of_body, carry = (
            given[:first],
            given[first : first + second],
            given[first + second :],
        )
        own = goes_on(*of_cond, *carry)[0]
        new = jaxpr_as_fun(body)(*of_body, *carry)
        like = lambda v: own.reshape(*own.shape, *(1,) * (v.ndim - own.ndim))  # noqa: E731
        return [jnp.where(like(v), w, v) for v, w in zip(carry, new, strict=True)]

    avals = [jax.typeof(x) for x in of_cond] + body.in_avals
    return lambda *given: [jnp.any(goes_on(*given)[0])], retraced(turn, avals)
