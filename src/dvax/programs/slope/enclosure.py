"""Slope arithmetic: an enclosure of a function's values and of its derivative over a whole region.

Every quantity is carried as a `Slope`: an interval of values, and for each array it is differentiated
by an interval of derivatives, as center and radius. Each operation of the user's f and h, read off its
jaxpr, has a rule that keeps this true for *every* point of the region, the generalised derivative of
max, min and |·| included. So what comes out bounds the Lipschitz modulus over a convex region,

    ‖fn(v) − fn(w)‖ ≤ sup ‖∂fn‖ ‖v − w‖,

and it is a proof, up to the rounding of its own arithmetic. Where an operation has no rule, or may
jump, the derivative is enclosed by (−∞, ∞): nothing is known, and nothing is claimed.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ..._tree import Tree
from ..interpreter import Domain, Rule, interpret
from .rules_elementwise import ELEMENTWISE
from .rules_structural import STRUCTURAL
from .rules_tables import TABLES
from .values import MOST, Part, Slope, TooLarge, entries, interval, is_slope

RULES: dict[str, Rule] = {**ELEMENTWISE, **STRUCTURAL, **TABLES}


class EnclosedSlopes(NamedTuple):
    """The slopes of a function's outputs, and the operations that nothing is known about."""

    out: Tree
    unknown: tuple[str, ...]


class SlopeEnclosure:
    """fn over regions: traced once, enclosed as often as a region is cut into pieces.

    **Arguments:** `fn`; `likes`, its arguments or their shapes; `wrt`, by which of them it is
    differentiated. The k-th part of a slope belongs to the k-th leaf of those, in their order.
    """

    def __init__(self, fn: Callable[..., Tree], likes: Sequence[Tree], wrt: Sequence[int]):
        shaped = jtu.tree_map(
            lambda v: jax.ShapeDtypeStruct(jnp.shape(v), jnp.result_type(float)), list(likes)
        )
        self._program, shape = jax.make_jaxpr(fn, return_shape=True)(*shaped)
        self._output = jtu.tree_structure(shape)
        self._wrt = [i in wrt for i, like in enumerate(likes) for _ in jtu.tree_leaves(like)]

    def __call__(self, *args: Tree) -> EnclosedSlopes:
        """The enclosure for these arguments, trees of intervals.

        **Raises:** `TooLarge`.
        """
        inputs, k = [], 0
        leaves = jtu.tree_leaves(args, is_leaf=is_slope)
        for leaf, differentiated in zip(leaves, self._wrt, strict=True):
            part = Part(np.ones(leaf.low.shape), np.zeros(leaf.low.shape), False)
            inputs.append(leaf._replace(parts={k: part} if differentiated else {}))
            k += differentiated
        unknown: list[str] = []
        with np.errstate(all="ignore"):
            domain = Domain(RULES, is_slope, partial(_unknown, unknown), _apply)
            results = interpret(self._program, inputs, domain)
        whole = [r if is_slope(r) else interval(np.asarray(r), np.asarray(r)) for r in results]
        return EnclosedSlopes(self._output.unflatten(whole), tuple(dict.fromkeys(unknown)))


def _apply(rule: Rule, eqn: Any, given: list[Any]) -> list[Any] | None:
    found = rule(eqn, given)
    if found is None:
        return None
    return [_settled(_sane(x)) for x in (found if isinstance(found, list) else [found])]


def _unknown(names: list[str], eqn: Any, given: list[Any]) -> list[Slope]:
    """What an operation without a rule leaves: anything, from everything that went in."""
    names.append(eqn.primitive.name)
    return [_anything(given, out.aval) for out in eqn.outvars]


def _anything(given: list[Any], aval: Any) -> Slope:
    parts = {}
    for value in filter(is_slope, given):
        for k, part in value.parts.items():
            if entries(part) * math.prod(aval.shape) > MOST:
                raise TooLarge
            shape = (entries(part), *aval.shape)
            parts[k] = Part(np.zeros(shape), np.full(shape, np.inf), True)
    if np.issubdtype(aval.dtype, np.bool_):
        return Slope(np.zeros(aval.shape, bool), np.ones(aval.shape, bool), parts)
    return Slope(np.full(aval.shape, -np.inf), np.full(aval.shape, np.inf), parts)


def _settled(x: Slope) -> Any:
    """A comparison that is decided all over the region is a constant there."""
    return x.low if x.low.dtype == bool and (x.low == x.high).all() else x


def _sane(x: Slope) -> Slope:
    """Where arithmetic with infinities left no number, nothing is known."""
    if x.low.dtype == bool:
        return x
    parts = {}
    for k, p in x.parts.items():
        lost = np.isnan(p.center) | np.isnan(p.radius) | np.isinf(p.center)
        if lost.any():
            p = Part(np.where(lost, 0.0, p.center), np.where(lost, np.inf, p.radius), p.full)
        parts[k] = p
    low = np.where(np.isnan(x.low), -np.inf, x.low)
    return Slope(low, np.where(np.isnan(x.high), np.inf, x.high), parts)
