"""A law whose code multiplies by a positive number: F(y) = a G(y), and the law without the weight.

Where h(t, x, u) = u − a(t, x, u) G(t, x, u) with a number a, F_{t,x}(y) = a G. If a ≥ M > 0 and G is
strongly monotone with modulus μ, F is strongly pseudomonotone with modulus Mμ, monotone or not (paper,
prop:weighted_strong_pseudomono, remark:assstrong (ii)). And VI(K, aG) and VI(K, G) have the same
solutions, so that the response may be bounded by the moduli of G, which are sharper.

The form is read off the code of h: its last two operations are a product and a difference from u.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._jax.jaxprs import ClosedJaxpr, Literal, bind, read
from ..problem import Problem
from .system import System


class Split(NamedTuple):
    """a(t, x, u), and the problem with u − G in the place of h."""

    weight: Callable[[Any, Any, Any], jax.Array]
    divided: Problem


def splits(system: System) -> list[Split]:
    """The weights that may be divided out, with what is left; none where h is not written like that."""
    problem, args = system.problem, system.args
    if isinstance(system.u0, tuple):
        return []
    h = lambda t, x, u: problem.h(t, x, u, args)  # noqa: E731
    time = jnp.zeros((), jnp.result_type(float))
    traced = jax.make_jaxpr(h)(time, system.x0, system.u0)
    return [_split(system, traced, *pair) for pair in _factors(traced, system.u0.shape)]


def _split(system: System, traced: ClosedJaxpr, a: Any, G: Any) -> Split:
    weight, rest = _output(traced, a), _output(traced, G)

    def number(t: Any, x: Any, u: Any) -> jax.Array:
        return weight(t, x, u).reshape(())

    def feedback(t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return u - rest(t, x, u).reshape(u.shape)

    return Split(number, eqx.tree_at(lambda p: p.h, system.problem, feedback))


def _factors(traced: ClosedJaxpr, shape: tuple[int, ...]) -> list[tuple[Any, Any]]:
    """The variables that hold a and G; of two numbers either may be a."""
    jaxpr = traced.jaxpr
    made = {out: eqn for eqn in jaxpr.eqns for out in eqn.outvars}
    last = _maker(made, jaxpr.outvars[0])
    if last is None or last.primitive.name != "sub" or last.invars[0] is not jaxpr.invars[-1]:
        return []
    product = _maker(made, last.invars[1])
    if product is None or product.primitive.name != "mul":
        return []
    pairs = [(_single(made, a), G) for a, G in (product.invars, product.invars[::-1])]
    return [(a, G) for a, G in pairs if a is not None and G.aval.shape == shape]


def _maker(made: dict[Any, Any], atom: Any) -> Any | None:
    return None if isinstance(atom, Literal) else made.get(atom)


def _single(made: dict[Any, Any], atom: Any) -> Any | None:
    """The one number that `atom` repeats."""
    while True:
        if isinstance(atom, Literal) or math.prod(atom.aval.shape) == 1:
            return atom
        eqn = _maker(made, atom)
        if eqn is None or eqn.primitive.name not in ("broadcast_in_dim", "reshape"):
            return None
        atom = eqn.invars[0]


def _output(traced: ClosedJaxpr, atom: Any) -> Callable[..., jax.Array]:
    """Return a function that computes an intermediate value of a program instead of its output."""
    if isinstance(atom, Literal):
        return lambda *inputs: jnp.asarray(atom.val)
    jaxpr = traced.jaxpr

    def fn(*inputs: Any) -> jax.Array:
        environment = dict(zip(jaxpr.constvars, traced.consts, strict=True))
        environment.update(zip(jaxpr.invars, jtu.tree_leaves(inputs), strict=True))
        for eqn in jaxpr.eqns:
            if atom in environment:
                break
            results = bind(eqn, read(environment, eqn.invars))
            environment.update(zip(eqn.outvars, results, strict=True))
        return jnp.asarray(environment[atom])

    return fn
