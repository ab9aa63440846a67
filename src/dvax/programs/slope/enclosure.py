"""Slope arithmetic: an enclosure of a function's values and of its derivative over a whole region.

Every quantity is represented by a `Slope`: an interval of values, and for each array of variables an
interval of derivatives, as center and radius. Each operation has a rule that is valid for *every* point
of the region, and includes the generalised derivatives of max, min and |·|. The result bounds the
Lipschitz modulus over a convex region,

    ‖fn(v) − fn(w)‖ ≤ sup ‖∂fn‖ ‖v − w‖,

rigorously except for the rounding errors of the interval arithmetic. If an operation has no rule, or
may jump, its derivative is enclosed by (−∞, ∞).
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ... import _tree
from ..._jax.jaxprs import bind, has_operation
from ..._jax.known_functions import operation
from ..._tree import Tree
from ..interpreter import Domain, Rule, interpret, operate
from .chains import CURVED, Chains
from .radial import RadialFunctions
from .rules_choice import CHOICE, choice_rules
from .rules_elementwise import ELEMENTWISE
from .rules_exponentials import of_exponentials
from .rules_functions import FUNCTIONS
from .rules_programs import PROGRAMS, program_rules
from .rules_scatter import SCATTER
from .rules_structural import STRUCTURAL
from .rules_tables import TABLES
from .sources import Recorder
from .values import MAX_ENTRIES, Part, Slope, TooLarge, entries, interval, is_slope, sharper

RULES: dict[str, Rule] = {
    **ELEMENTWISE,
    **CHOICE,
    **STRUCTURAL,
    **SCATTER,
    **TABLES,
    **FUNCTIONS,
    **PROGRAMS,
}


class EnclosedSlopes(NamedTuple):
    """The slopes of the outputs of a function, and the names of the operations without a rule."""

    out: Tree
    unknown: tuple[str, ...]


class SlopeEnclosure:
    """The enclosure of fn as a function of a region; fn is traced once.

    **Arguments:** `fn`: the function; `likes`: its arguments or their shapes; `wrt`: the numbers of the
    arguments by which it is differentiated. The k-th part of a slope belongs to the k-th leaf of these.
    """

    def __init__(self, fn: Callable[..., Tree], likes: Sequence[Tree], wrt: Sequence[int]):
        shaped = jtu.tree_map(
            lambda v: jax.ShapeDtypeStruct(jnp.shape(v), jnp.result_type(float)), list(likes)
        )
        self._program, shape = jax.make_jaxpr(fn, return_shape=True)(*shaped)
        self._output = jtu.tree_structure(shape)
        # Sources cost time and memory, and serve selections and chains only.
        self._has_sources = has_operation(self._program, {"select_n", "cond"} | CURVED)
        self._wrt = [i in wrt for i, like in enumerate(likes) for _ in jtu.tree_leaves(like)]

    def __call__(self, *args: Tree) -> EnclosedSlopes:
        """Return the enclosure for these arguments, which are trees of intervals.

        **Raises:** `TooLarge` if a matrix of derivatives is too large.
        """
        unknown: list[str] = []
        recorder, chains, radial = None, None, None
        if self._has_sources:
            chains, radial = Chains(_elementwise), RadialFunctions(_elementwise)
            recorder = Recorder(lambda eqn, x: operate(eqn, x, domain), chains.tightened)
        inputs, k = [], 0
        leaves = jtu.tree_leaves(args, is_leaf=is_slope)
        for leaf, differentiated in zip(leaves, self._wrt, strict=True):
            part = Part(np.ones(leaf.low.shape), np.zeros(leaf.low.shape), False)
            leaf = leaf._replace(parts={k: part} if differentiated else {})
            inputs.append(leaf if recorder is None else recorder.input(leaf))
            k += differentiated
        run = lambda program, x: interpret(program, x, domain)  # noqa: E731
        rules = RULES | choice_rules(recorder, run) | program_rules(run)
        apply = partial(_apply, recorder, chains, radial)
        domain = Domain(rules, is_slope, partial(_unknown, unknown), apply, _evaluate)
        with np.errstate(all="ignore"):
            results = interpret(self._program, inputs, domain)
            if chains is not None:
                results = [chains.tightened(r) for r in results]
        slopes = [r if is_slope(r) else interval(np.asarray(r), np.asarray(r)) for r in results]
        return EnclosedSlopes(self._output.unflatten(slopes), tuple(dict.fromkeys(unknown)))


def _elementwise(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the result of an elementwise operation, None where its rule does not cover it."""
    result = ELEMENTWISE[eqn.primitive.name](eqn, operands)
    inherited = any(is_slope(v) and v.undefined for v in operands)
    return None if result is None else _without_nan(_marked(result, inherited))


def _apply(
    recorder: Recorder | None,
    chains: Chains | None,
    radial: RadialFunctions | None,
    rule: Rule,
    eqn: Any,
    operands: list[Any],
) -> list[Any] | None:
    if chains is not None:
        operands = chains.operands(eqn, operands)
    result = rule(eqn, operands)
    if result is None:
        return None
    results = result if isinstance(result, list) else [result]
    inherited = _may_be_undefined(eqn, operands)
    if inherited:
        # NaN decides no comparison as its range does.
        results = [
            _anything(operands, out.aval) if is_slope(x) and x.low.dtype == bool else x
            for x, out in zip(results, eqn.outvars, strict=True)
        ]
    values = [
        _constant_if_decided(_without_nan(_marked(x, inherited))) if is_slope(x) else x
        for x in results
    ]
    if recorder is None or radial is None:
        return values
    values = [recorder.result(x, eqn, operands, k) for k, x in enumerate(values)]
    if is_slope(values[0]):
        for whole in (of_exponentials(eqn, operands, values[0]), radial.of(values[0])):
            if whole is not None:
                values[0] = sharper(values[0], _without_nan(_marked(whole, False)))
    return values


def _marked(x: Slope, inherited: bool) -> Slope:
    """Return a result with the mark whether it may be NaN."""
    has_nan = x.low.dtype.kind == "f" and bool((np.isnan(x.low) | np.isnan(x.high)).any())
    return x._replace(undefined=inherited or has_nan or x.undefined)


def _may_be_undefined(eqn: Any, operands: list[Any]) -> bool:
    """Return whether the result of an operation may depend on a value that may be NaN."""
    flags = [is_slope(v) and v.undefined for v in operands]
    if eqn.primitive.name == "select_n" and any(flags) and not is_slope(operands[0]):
        which = np.asarray(operands[0]).astype(int)
        return any(flag and bool((which == k).any()) for k, flag in enumerate(flags[1:]))
    return any(flags)


_ARITHMETIC = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative,
    "sqrt": np.sqrt, "max": np.maximum, "min": np.minimum,
}  # fmt: skip


def _evaluate(eqn: Any, operands: list[Any]) -> list[Any]:
    """Return the results of an operation on constants. NumPy rounds arithmetic as XLA does, and
    compiles no program."""
    name, aval = operation(eqn), eqn.outvars[0].aval
    is_known = _tree.is_concrete(operands) and not any(map(_tree.is_key, operands))
    if is_known and jnp.issubdtype(aval.dtype, jnp.floating):
        arrays = [np.asarray(v) for v in operands]
        if name in _ARITHMETIC and all(a.dtype == aval.dtype for a in arrays):
            return [np.asarray(_ARITHMETIC[name](*arrays))]
        if name == "convert_element_type" and arrays[0].dtype.kind in "iuf":
            return [arrays[0].astype(aval.dtype)]
        if name == "broadcast_in_dim":
            axes = [1] * aval.ndim
            for axis, size in zip(eqn.params["broadcast_dimensions"], arrays[0].shape, strict=True):
                axes[axis] = size
            return [np.broadcast_to(arrays[0].reshape(axes), aval.shape)]
    return bind(eqn, operands)


def _unknown(names: list[str], eqn: Any, operands: list[Any]) -> list[Slope]:
    """Return unbounded results that depend on all arguments, and append the name of the operation."""
    names.append(eqn.primitive.name)
    return [_anything(operands, out.aval) for out in eqn.outvars]


def _anything(operands: list[Any], aval: Any) -> Slope:
    parts = {}
    for value in filter(is_slope, operands):
        for k, part in value.parts.items():
            if entries(part) * math.prod(aval.shape) > MAX_ENTRIES:
                raise TooLarge
            shape = (entries(part), *aval.shape)
            parts[k] = Part(np.zeros(shape), np.full(shape, np.inf), True)
    if np.issubdtype(aval.dtype, np.bool_):
        return Slope(np.zeros(aval.shape, bool), np.ones(aval.shape, bool), parts)
    whole = np.full(aval.shape, np.inf)
    return Slope(-whole, whole, parts, undefined=True)


def _constant_if_decided(x: Slope) -> Any:
    """Return a comparison, or an index, that is the same in the whole region as a constant."""
    return x.low if x.low.dtype.kind in "biu" and (x.low == x.high).all() else x


def _without_nan(x: Slope) -> Slope:
    """Return the slope with unbounded intervals in place of NaN, the result of ∞ − ∞ and the like."""
    if x.low.dtype.kind != "f":
        return x
    parts = {}
    for k, p in x.parts.items():
        unknown = np.isnan(p.center) | np.isnan(p.radius) | np.isinf(p.center)
        if unknown.any():
            p = Part(np.where(unknown, 0.0, p.center), np.where(unknown, np.inf, p.radius), p.full)
        parts[k] = p
    low = np.where(np.isnan(x.low), -np.inf, x.low)
    return x._replace(low=low, high=np.where(np.isnan(x.high), np.inf, x.high), parts=parts)
