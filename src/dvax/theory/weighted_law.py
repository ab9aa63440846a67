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

from .._jax.jaxprs import ClosedJaxpr, Literal
from ..problem import Problem
from ..programs.intermediate import intermediate, maker, subtracted
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
    weight, rest = intermediate(traced, a), intermediate(traced, G)

    def number(t: Any, x: Any, u: Any) -> jax.Array:
        return weight(t, x, u).reshape(())

    def feedback(t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return u - rest(t, x, u).reshape(u.shape)

    return Split(number, eqx.tree_at(lambda p: p.h, system.problem, feedback))


def _factors(traced: ClosedJaxpr, shape: tuple[int, ...]) -> list[tuple[Any, Any]]:
    """The variables that hold a and G; of two numbers either may be a."""
    product = maker(traced, subtracted(traced))
    if product is None or product.primitive.name != "mul":
        return []
    pairs = [(_single(traced, a), G) for a, G in (product.invars, product.invars[::-1])]
    return [(a, G) for a, G in pairs if a is not None and G.aval.shape == shape]


def _single(traced: ClosedJaxpr, atom: Any) -> Any | None:
    """The one number that `atom` repeats."""
    while True:
        if isinstance(atom, Literal) or math.prod(atom.aval.shape) == 1:
            return atom
        eqn = maker(traced, atom)
        if eqn is None or eqn.primitive.name not in ("broadcast_in_dim", "reshape"):
            return None
        atom = eqn.invars[0]
