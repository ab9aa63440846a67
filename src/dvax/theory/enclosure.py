"""Slope arithmetic: an enclosure of a function's values and of its derivative over a whole region.

Every quantity is carried as a `Slope`: an interval of values, and for each array it is differentiated
by an interval of derivatives, as center and radius. Each operation of the user's f and h, read off its
jaxpr, has a rule that keeps this true for *every* point of the region, the generalised derivative of
max, min and |·| included. So what comes out bounds the Lipschitz modulus over a convex region,

    ‖fn(v) − fn(w)‖ ≤ sup ‖∂fn‖ ‖v − w‖,

and it is a proof, up to the rounding of its own arithmetic. Where an operation has no rule, or may
jump, the derivative is enclosed by (−∞, ∞): nothing is known, and nothing is claimed.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.extend.core import ClosedJaxpr

from .._tree import Tree
from ..vi.structure import CALLS, CUSTOM, evaluate, inner_jaxpr
from .slope import Part, Slope, interval, is_slope, nothing
from .slope_entrywise import ENTRYWISE
from .slope_moves import MOVING, split
from .slope_tables import TABLES

_RULES = {**ENTRYWISE, **MOVING}


class Enclosed(NamedTuple):
    """The slopes of a function's outputs, and the operations that nothing is known about."""

    out: Tree
    unknown: tuple[str, ...]


class Enclosure:
    """fn over regions: traced once, enclosed as often as a region is cut into pieces.

    **Arguments:** `fn`; `likes`, its arguments or their shapes; `wrt`, by which of them it is
    differentiated. The k-th part of a slope belongs to the k-th leaf of those, in their order.
    """

    def __init__(self, fn: Callable[..., Tree], likes: Sequence[Tree], wrt: Sequence[int]):
        shaped = jtu.tree_map(
            lambda v: jax.ShapeDtypeStruct(jnp.shape(v), jnp.result_type(float)), list(likes)
        )
        self._traced, shape = jax.make_jaxpr(fn, return_shape=True)(*shaped)
        self._output = jtu.tree_structure(shape)
        self._wrt = [i in wrt for i, like in enumerate(likes) for _ in jtu.tree_leaves(like)]

    def __call__(self, *args: Tree) -> Enclosed:
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
            results = _interpret(self._traced, inputs, unknown)
        whole = [r if is_slope(r) else interval(np.asarray(r), np.asarray(r)) for r in results]
        return Enclosed(self._output.unflatten(whole), tuple(dict.fromkeys(unknown)))


def _interpret(traced: ClosedJaxpr, inputs: list[Any], unknown: list[str]) -> list[Any]:
    return evaluate(traced, inputs, is_slope, partial(_apply, unknown))


def _apply(unknown: list[str], eqn: Any, given: list[Any]) -> list[Any]:
    name = eqn.primitive.name
    table = TABLES.get(eqn.params.get("name", "")) if name in CALLS else None
    result = None if table is None else table(eqn, given)
    if result is not None:
        return [_sane(result)]
    if name in CALLS or name in CUSTOM:
        inner = inner_jaxpr(eqn.params)
        if inner is not None and len(inner.jaxpr.invars) == len(given):
            return _interpret(inner, given, unknown)
    if name == "split":
        return [_settled(_sane(piece)) for piece in split(eqn, given)]
    rule = _RULES.get(name)
    result = None if rule is None else rule(eqn, given)
    if result is None:
        unknown.append(name)
        return [nothing(given, out.aval) for out in eqn.outvars]
    return [_settled(_sane(result))]


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
