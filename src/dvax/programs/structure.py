"""What an operator's own code proves about it: affine? pointwise?

A function traced to a program is a list of primitive operations, so its dependence on y can be read
off, operation by operation, and what is read is a proof: adding two affine things is affine,
multiplying two that both contain y is not. Sampling could never say as much. Whatever is not
understood is taken to be general.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._jax.jaxprs import CUSTOM
from .._tree import Tree
from .interpreter import Domain, Rule, entered, interpret, same_for
from .primitives import COMPARING, JOINING, LOGICAL, REARRANGING, STEPWISE, SUMMING
from .smooth import SMOOTH


class Structure(NamedTuple):
    """What is proved of F; False means "not shown", never "shown not to be".

    `affine`: F(y) = Jy + c with J independent of y. `pointwise`: Fᵢ depends on yᵢ alone.
    `isotropic`: affine and pointwise with one factor for all entries, F(y) = ay + c, so that
    y* = proj_K(−c/a) for every K (each part of a tuple may have its own a).
    """

    affine: bool
    pointwise: bool
    isotropic: bool


class _Dependence(NamedTuple):
    """How one intermediate value depends on y.

    `degree`: 0 independent, 1 affine, 2 anything. `leaf`: the leaf of y that it depends on entry by
    entry, by number and shape (None: several leaves, mixed entries, or no dependence). `uniform`: the
    same number in every entry; of degree 1, that leaf times one number, plus what is independent of y.
    """

    degree: int
    leaf: tuple[int, tuple[int, ...]] | None
    uniform: bool


def analyse(F: Callable[[Tree], Tree], like: Tree) -> Structure:
    """The structure of F at arguments shaped like `like`, proved from its operations."""
    shapes = [tuple(jnp.shape(leaf)) for leaf in jtu.tree_leaves(like)]
    inputs = [_Dependence(1, leaf, True) for leaf in enumerate(shapes)]
    outputs = _read(jax.make_jaxpr(F)(like), inputs)
    affine = all(out.degree <= 1 for out in outputs)
    pointwise = len(outputs) == len(inputs) and all(
        out.degree == 0 or out.leaf == of.leaf for out, of in zip(outputs, inputs, strict=True)
    )
    isotropic = affine and pointwise and all(out.degree == 1 and out.uniform for out in outputs)
    return Structure(affine, pointwise, isotropic)


def independent(fn: Callable[..., Tree], *args: Tree) -> bool:
    """Whether no output of fn(*args) depends on any of the args, as far as its code shows."""
    program = jax.make_jaxpr(fn)(*args)
    inputs = [_Dependence(1, None, False) for _ in program.jaxpr.invars]
    return all(out.degree == 0 for out in _read(program, inputs))


def _read(program: Any, inputs: list[_Dependence]) -> list[_Dependence]:
    return list(map(_lift, interpret(program, inputs, _DOMAIN)))


def _lift(value: Any) -> _Dependence:
    """What is known of a value; an array does not depend on y."""
    if isinstance(value, _Dependence):
        return value
    return _Dependence(0, None, jnp.shape(value) == ())


def _together(eqn: Any, given: list[_Dependence]) -> _Dependence:
    """What a sum of the arguments is."""
    shape = eqn.outvars[0].aval.shape
    present = [(value, atom) for value, atom in zip(given, eqn.invars, strict=True) if value.degree]
    leaves = {value.leaf for value, _ in present}
    # Entry by entry only while shapes agree: anything else moves entries about.
    leaf = leaves.pop() if len(leaves) == 1 else None
    if leaf is None or leaf[1] != shape or any(atom.aval.shape != shape for _, atom in present):
        leaf = None
    uniform = leaf is not None and all(value.uniform for value, _ in present)
    return _Dependence(max(value.degree for value in given), leaf, uniform)


def _product(eqn: Any, given: list[_Dependence]) -> _Dependence:
    degree = min(2, sum(value.degree for value in given))
    return _scaled(eqn, given)._replace(degree=degree)


def _scaled(eqn: Any, given: list[_Dependence]) -> _Dependence:
    found = _together(eqn, given)
    return found._replace(uniform=found.uniform and all(value.uniform for value in given))


def _quotient(eqn: Any, given: list[_Dependence]) -> _Dependence:
    found = _scaled(eqn, given)
    return found._replace(degree=2) if given[1].degree else found


def _choice(eqn: Any, given: list[_Dependence]) -> _Dependence:
    found = _together(eqn, given)._replace(uniform=False)
    return found._replace(degree=2) if given[0].degree else found


def _conversion(eqn: Any, given: list[_Dependence]) -> _Dependence:
    # To integers, booleans and shorter floating types it makes steps.
    before, after = eqn.invars[0].aval.dtype, eqn.outvars[0].aval.dtype
    exact = jnp.issubdtype(after, jnp.inexact) and (
        not jnp.issubdtype(before, jnp.inexact) or jnp.finfo(after).eps <= jnp.finfo(before).eps
    )
    found = _together(eqn, given)
    return found if exact else found._replace(degree=2)


def _pointwise(eqn: Any, given: list[_Dependence]) -> _Dependence:
    return _Dependence(2, _together(eqn, given).leaf, False)


def _mixing(eqn: Any, given: list[_Dependence]) -> _Dependence:
    """Linear in every argument; entries change their places, or are added up."""
    return _Dependence(max(value.degree for value in given), None, False)


def _picking(eqn: Any, given: list[_Dependence]) -> _Dependence:
    """The same in the first argument alone: places that depend on y are not linear in it."""
    return _Dependence(2 if any(v.degree for v in given[1:]) else given[0].degree, None, False)


def _reshaping(eqn: Any, given: list[_Dependence]) -> _Dependence:
    # A reshape may permute the axes first.
    same = eqn.invars[0].aval.shape == eqn.outvars[0].aval.shape
    keeps = same and eqn.params.get("dimensions") in (None, ())
    return given[0] if keeps else _mixing(eqn, given)


def _matrix_product(eqn: Any, given: list[_Dependence]) -> _Dependence:
    return _Dependence(min(2, sum(value.degree for value in given)), None, False)


def _sparse_product(eqn: Any, given: list[_Dependence]) -> _Dependence:
    # The second argument holds the places of the first.
    return _general(eqn, given) if given[1].degree else _matrix_product(eqn, given)


def _scatter_add(eqn: Any, given: list[_Dependence]) -> _Dependence:
    return _general(eqn, given) if given[1].degree else _mixing(eqn, given)


def _linear_solve(eqn: Any, given: list[_Dependence]) -> _Dependence:
    return _general(eqn, given) if given[0].degree else _mixing(eqn, given)


def _general(eqn: Any, given: list[Any]) -> _Dependence:
    return _Dependence(2, None, False)


def _custom(eqn: Any, given: list[Any]) -> list[_Dependence] | None:
    """A derivative rule of its own need not be the slope of the values."""
    results = entered(eqn, given, _DOMAIN)
    if results is None:
        return None
    return [out._replace(degree=2) if out.degree else out for out in map(_lift, results)]


RULES: dict[str, Rule] = {
    **same_for(SMOOTH.keys() | COMPARING | LOGICAL | STEPWISE, _pointwise),
    **same_for({
        "max", "min", "atan2", "erf_inv", "abs", "pow", "integer_pow", "clamp", "rem", "nextafter",
        "is_finite", "lgamma", "digamma", "reduce_precision",
    }, _pointwise),
    **same_for(
        {"neg", "copy", "copy_p", "real", "imag", "optimization_barrier", "add", "sub", "add_any"},
        _together,
    ),
    **same_for((REARRANGING | SUMMING | {"dynamic_slice", "gather"}) - {"copy", "copy_p"}, _picking),
    **same_for({"reshape", "squeeze", "broadcast_in_dim"}, _reshaping),
    **same_for(JOINING | {"pad", "fft"}, _mixing),
    **same_for({"dot_general", "conv_general_dilated"}, _matrix_product),
    **same_for({"scatter-add", "scatter_add"}, _scatter_add),
    **same_for(CUSTOM, _custom),
    "mul": _product,
    "div": _quotient,
    "select_n": _choice,
    "convert_element_type": _conversion,
    "bcoo_dot_general": _sparse_product,
    "triangular_solve": _linear_solve,
    # Linear in value, but its derivative is 0, and the slope of a law is taken by differentiating.
    "stop_gradient": _pointwise,
}  # fmt: skip

_UNIFORM = {
    name for name, rule in RULES.items() if rule in (_pointwise, _together, _product, _quotient)
} | {"convert_element_type", "broadcast_in_dim"}
"""Operations that make one number of arguments that are one number each."""


def _apply(rule: Rule, eqn: Any, given: list[Any]) -> list[_Dependence] | None:
    found = rule(eqn, list(map(_lift, given)))
    return [found] * len(eqn.outvars) if isinstance(found, _Dependence) else found


def _constant(eqn: Any, given: list[Any]) -> list[_Dependence]:
    """The results of an operation on what does not depend on y."""
    same = eqn.primitive.name in _UNIFORM and all(_lift(value).uniform for value in given)
    return [_Dependence(0, None, same or out.aval.shape == ()) for out in eqn.outvars]


_DOMAIN = Domain(
    RULES,
    is_abstract=lambda value: isinstance(value, _Dependence) and value.degree > 0,
    unknown=lambda eqn, given: [_general(eqn, given)] * len(eqn.outvars),
    apply=_apply,
    evaluate=_constant,
)
