"""Proofs from the code of an operator that it is affine, pointwise, or independent of its arguments.

The interpreter propagates the dependence on y through the operations of the traced program: a sum of
affine terms is affine, a product of two factors that depend on y is not. This is a proof, which
sampling could not give. An operation without a rule counts as a general dependence.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._jax.jaxprs import CUSTOM
from .._tree import Tree
from .interpreter import Domain, Rule, entered, interpret, same_for
from .primitives import COMPARING, JOINING, LOGICAL, REARRANGING, STEPWISE, SUMMING, TABLES
from .smooth import SMOOTH


class Structure(NamedTuple):
    """Proved properties of F. False means "not proved", not "disproved".

    - `affine`: F(y) = Jy + c with J independent of y;
    - `pointwise`: Fᵢ depends on yᵢ only;
    - `isotropic`: affine and pointwise with one factor for all entries, F(y) = ay + c, so that
      y* = proj_K(−c/a) for every K. Each part of a tuple may have another a.

    ```python
    >>> import jax.numpy as jnp
    >>> from dvax.vi import analyse
    >>> analyse(lambda y: jnp.exp(y) + y, jnp.zeros(3))
    Structure(affine=False, pointwise=True, isotropic=False)

    ```
    """

    affine: bool
    pointwise: bool
    isotropic: bool


class _Dependence(NamedTuple):
    """The dependence of an intermediate value on y.

    - `degree`: 0 independent, 1 affine, 2 general;
    - `leaf`: the number and shape of the leaf of y on which it depends entry by entry; None if it
      depends on several leaves, on mixed entries, or not at all;
    - `uniform`: for degree 0, all entries are equal; for degree 1, the value is one number times that
      leaf, plus a term that is independent of y.
    """

    degree: int
    leaf: tuple[int, tuple[int, ...]] | None
    uniform: bool


def analyse(F: Callable[[Tree], Tree], like: Tree) -> Structure:
    """Return the structure of F for arguments of the shape of `like`, proved from its operations.

    ```python
    >>> import jax.numpy as jnp
    >>> from dvax.vi import analyse
    >>> analyse(lambda y: 2.0 * y - jnp.array([1.0, 2.0]), jnp.zeros(2))
    Structure(affine=True, pointwise=True, isotropic=True)

    ```
    """
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
    """Return whether the code of `fn` proves that no output of fn(*args) depends on the args.

    ```python
    >>> import jax.numpy as jnp
    >>> from dvax.vi import independent
    >>> independent(lambda y: jnp.zeros(2), jnp.ones(2))
    True
    >>> independent(lambda y: y[::-1], jnp.ones(2))
    False

    ```
    """
    return independent_of_first(lambda args: fn(*args), args)


def independent_of_first(fn: Callable[..., Tree], first: Tree, *others: Tree) -> bool:
    """Return whether the code of `fn` proves that fn(first, *others) does not depend on `first`,
    whatever the others are.

    ```python
    >>> from dvax.programs.structure import independent_of_first
    >>> independent_of_first(lambda t, x: 2.0 * x, 0.0, 1.0)
    True
    >>> independent_of_first(lambda t, x: t * x, 0.0, 0.0)
    False

    ```
    """
    program = jax.make_jaxpr(fn)(first, *others)
    count = len(jtu.tree_leaves(first))
    inputs = [_Dependence(int(i < count), None, False) for i in range(len(program.jaxpr.invars))]
    return all(out.degree == 0 for out in _read(program, inputs))


class BetweenKnots(NamedTuple):
    """Proved properties of a function of time, where the times of its `dvax.signals.Table` are knots.

    - `knows_knots`: every table is evaluated at t itself, so that its times are known as knots;
    - `affine`: the function is affine in t between them."""

    knows_knots: bool
    affine: bool


def between_knots(fn: Callable[[Any], Tree], t: Any) -> BetweenKnots:
    """Return what the code of fn(t) proves.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> from dvax.programs.structure import between_knots
    >>> load = dvax.signals.Table(jnp.array([0.0, 1.0, 2.0]), jnp.array([3.0, 5.0, 4.0]))
    >>> between_knots(lambda t: 2.0 * load(t) + t, 0.0)
    BetweenKnots(knows_knots=True, affine=True)
    >>> between_knots(lambda t: load(0.5 * t) ** 2, 0.0)
    BetweenKnots(knows_knots=False, affine=False)

    ```
    """
    time, others = _Dependence(1, (0, ()), True), []

    def table(eqn: Any, operands: list[_Dependence]) -> _Dependence:
        *data, at = operands
        if at.degree and at is not time:
            others.append(eqn)
        is_piecewise_linear = eqn.params["name"] != "dvax_cubic_table"
        is_affine = is_piecewise_linear and not any(v.degree for v in data)
        return _Dependence(at.degree if is_affine else 2, None, False)

    domain = _DOMAIN._replace(rules={**RULES, **same_for(TABLES, table)})
    results = interpret(jax.make_jaxpr(fn)(t), [time], domain)
    return BetweenKnots(not others, all(out.degree <= 1 for out in map(_lift, results)))


def _read(program: Any, inputs: list[_Dependence]) -> list[_Dependence]:
    return list(map(_lift, interpret(program, inputs, _DOMAIN)))


def _lift(value: Any) -> _Dependence:
    """Return the dependence of a value; a concrete array does not depend on y."""
    if isinstance(value, _Dependence):
        return value
    return _Dependence(0, None, jnp.shape(value) == ())


def _together(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    """Return the dependence of a sum of the arguments."""
    shape = eqn.outvars[0].aval.shape
    present = [
        (value, atom) for value, atom in zip(operands, eqn.invars, strict=True) if value.degree
    ]
    leaves = {value.leaf for value, _ in present}
    # The sum is entrywise only if all shapes agree.
    leaf = leaves.pop() if len(leaves) == 1 else None
    if leaf is None or leaf[1] != shape or any(atom.aval.shape != shape for _, atom in present):
        leaf = None
    uniform = leaf is not None and all(value.uniform for value, _ in present)
    return _Dependence(max(value.degree for value in operands), leaf, uniform)


def _product(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    degree = min(2, sum(value.degree for value in operands))
    return _scaled(eqn, operands)._replace(degree=degree)


def _scaled(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    total = _together(eqn, operands)
    return total._replace(uniform=total.uniform and all(value.uniform for value in operands))


def _quotient(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    quotient = _scaled(eqn, operands)
    return quotient._replace(degree=2) if operands[1].degree else quotient


def _choice(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    choice = _together(eqn, operands)._replace(uniform=False)
    return choice._replace(degree=2) if operands[0].degree else choice


def _conversion(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    # A conversion to integers, Booleans or a shorter floating-point type is a step function.
    before, after = eqn.invars[0].aval.dtype, eqn.outvars[0].aval.dtype
    exact = jnp.issubdtype(after, jnp.inexact) and (
        not jnp.issubdtype(before, jnp.inexact) or jnp.finfo(after).eps <= jnp.finfo(before).eps
    )
    value = _together(eqn, operands)
    return value if exact else value._replace(degree=2)


def _pointwise(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    return _Dependence(2, _together(eqn, operands).leaf, False)


def _mixing(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    """Return the dependence of an operation that is linear in every argument, but not entrywise."""
    return _Dependence(max(value.degree for value in operands), None, False)


def _picking(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    """Return the dependence of an operation that is linear in its first argument only: it is not linear
    in indices."""
    return _Dependence(
        2 if any(v.degree for v in operands[1:]) else operands[0].degree, None, False
    )


def _reshaping(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    # A reshape may permute the axes first.
    same_shape = eqn.invars[0].aval.shape == eqn.outvars[0].aval.shape
    is_identity = same_shape and eqn.params.get("dimensions") in (None, ())
    return operands[0] if is_identity else _mixing(eqn, operands)


def _matrix_product(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    return _Dependence(min(2, sum(value.degree for value in operands)), None, False)


def _sparse_product(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    # The second argument contains the indices of the entries in the first one.
    return _general(eqn, operands) if operands[1].degree else _matrix_product(eqn, operands)


def _scatter(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    """Return the dependence of values that are written, or added, into an array at some indices."""
    return _general(eqn, operands) if operands[1].degree else _mixing(eqn, operands)


def _update(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    """Return the dependence of an array with a block in the place of some entries."""
    is_fixed = not any(index.degree for index in operands[2:])
    return _mixing(eqn, operands) if is_fixed else _general(eqn, operands)


def _linear_solve(eqn: Any, operands: list[_Dependence]) -> _Dependence:
    return _general(eqn, operands) if operands[0].degree else _mixing(eqn, operands)


def _general(eqn: Any, operands: list[Any]) -> _Dependence:
    return _Dependence(2, None, False)


def _custom(eqn: Any, operands: list[Any]) -> list[_Dependence] | None:
    """Return the dependence of a call with a custom derivative rule, which need not be the derivative
    of the values: any dependence counts as general."""
    results = entered(eqn, operands, _DOMAIN)
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
        {
            "neg", "copy", "copy_p", "real", "imag", "complex", "conj", "optimization_barrier", "add",
            "sub", "add_any",
        },
        _together,
    ),
    **same_for((REARRANGING | SUMMING | {"dynamic_slice", "gather"}) - {"copy", "copy_p"}, _picking),
    **same_for({"reshape", "squeeze", "broadcast_in_dim"}, _reshaping),
    **same_for(JOINING | {"pad", "fft"}, _mixing),
    **same_for({"dot_general", "conv_general_dilated"}, _matrix_product),
    **same_for({"scatter", "scatter-add", "scatter_add"}, _scatter),
    "dynamic_update_slice": _update,
    **same_for(CUSTOM, _custom),
    "mul": _product,
    "div": _quotient,
    "select_n": _choice,
    "convert_element_type": _conversion,
    "bcoo_dot_general": _sparse_product,
    "triangular_solve": _linear_solve,
    # Its value is linear, but its derivative is 0, and the slope of a law is its derivative.
    "stop_gradient": _pointwise,
}  # fmt: skip

_UNIFORM = {
    name for name, rule in RULES.items() if rule in (_pointwise, _together, _product, _quotient)
} | {"convert_element_type", "broadcast_in_dim"}
"""Operations whose result has equal entries if each of their arguments has."""


def _apply(rule: Rule, eqn: Any, operands: list[Any]) -> list[_Dependence] | None:
    result = rule(eqn, list(map(_lift, operands)))
    return [result] * len(eqn.outvars) if isinstance(result, _Dependence) else result


def _constant(eqn: Any, operands: list[Any]) -> list[_Dependence]:
    """Return the results of an operation whose arguments do not depend on y."""
    uniform = eqn.primitive.name in _UNIFORM and all(_lift(value).uniform for value in operands)
    return [_Dependence(0, None, uniform or out.aval.shape == ()) for out in eqn.outvars]


_DOMAIN = Domain(
    RULES,
    is_abstract=lambda value: isinstance(value, _Dependence) and value.degree > 0,
    unknown=lambda eqn, operands: [_general(eqn, operands)] * len(eqn.outvars),
    apply=_apply,
    evaluate=_constant,
)
