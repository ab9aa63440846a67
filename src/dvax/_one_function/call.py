"""A program as one function, as a primitive: its batches and derivatives are such functions too."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Primitive, Var, jaxpr_as_fun, new_jaxpr_eqn
from jax.interpreters import ad, batching, mlir
from jax.interpreters import partial_eval as pe

from .begun import handed_over
from .divided import can_divide, divided
from .marked import as_one, available, is_of_one_device
from .packed import can_pack, in_a_row, packed, unpacked
from .small import LARGEST, is_small
from .within import summed_by_parts


def in_one_function(
    run: Callable[..., Any],
    *args: Any,
    computed: Any = (),
    otherwise: Callable[..., Any] | None = None,
) -> Any:
    """run(*args, *computed), compiled as one function where it is small and this is a CPU, or its loops
    as few where they are small but for calls of a library. What another such function has `computed`
    may be as large as it likes.

    A batch of it and its derivatives are such functions too; unless there is another way to the same
    result, which is then taken `otherwise`, and can be transposed."""
    arrays, static = eqx.partition((args, computed), eqx.is_array)
    leaves, tree = jtu.tree_flatten(arrays)
    large = [False] * len(jtu.tree_leaves(arrays[0])) + [True] * len(jtu.tree_leaves(arrays[1]))
    if not (available() and can_pack(_small_ones(leaves, large))):
        return (otherwise or run)(*args, *computed)
    rest: list[Any] = []

    def flattened(run: Callable[..., Any]) -> Callable[..., list[Any]]:
        def flat(*leaves: Any) -> list[Any]:
            args, computed = eqx.combine(jtu.tree_unflatten(tree, leaves), static)
            out, kept = eqx.partition(run(*args, *computed), eqx.is_array)
            found, shape = jtu.tree_flatten(out)
            rest[:] = [kept, shape]
            return found

        return flat

    other = None if otherwise is None else flattened(otherwise)
    found = _called(flattened(run), leaves, large, other)
    return eqx.combine(jtu.tree_unflatten(rest[1], found), rest[0])


def _called(
    flat: Callable[..., list[Any]],
    leaves: list[Any],
    large: list[bool],
    otherwise: Callable[..., list[Any]] | None = None,
) -> list[Any]:
    """flat(*leaves), as one function where it is small."""
    opened, consts = _opened(jax.make_jaxpr(flat)(*leaves))
    whole, large = [*consts, *leaves], [False] * len(consts) + large
    is_one = can_pack(_small_ones(whole, large)) and (is_small(opened) or can_divide(opened))
    if otherwise is None:
        other = None
        if not is_one:
            return jaxpr_as_fun(opened)(*whole)
    else:
        # Run later, it would find that what it closes over is no more.
        if not is_one or any(isinstance(const, Tracer) for const in consts):
            return otherwise(*leaves)
        other = lambda *given: otherwise(*given[len(consts) :])  # noqa: E731
    return _one_p.bind(*whole, program=opened, large=tuple(large), otherwise=other)


def _opened(program: ClosedJaxpr) -> tuple[ClosedJaxpr, list[Any]]:
    """The program with what it closes over as its first arguments, equal arrays as one: those that are
    written out in a user's function are new ones at every call of it."""
    jaxpr = program.jaxpr
    first: dict[Any, Any] = {}
    same = {
        var: first.setdefault(_value(const), (var, const))
        for var, const in zip(jaxpr.constvars, program.consts, strict=True)
    }
    swap = lambda v: same[v][0] if isinstance(v, Var) and v in same else v  # noqa: E731
    equations = [eqn.replace(invars=list(map(swap, eqn.invars))) for eqn in jaxpr.eqns]
    opened = jaxpr.replace(
        constvars=[], invars=[*(var for var, _ in first.values()), *jaxpr.invars], eqns=equations,
        outvars=list(map(swap, jaxpr.outvars)), debug_info=jaxpr.debug_info.with_unknown_names(),
    )  # fmt: skip
    return ClosedJaxpr(opened, ()), [const for _, const in first.values()]


def _value(const: Any) -> Any:
    """What tells a constant from others: its entries, where they are known."""
    is_key = jnp.issubdtype(const.dtype, jax.dtypes.extended)
    if isinstance(const, Tracer) or is_key or math.prod(jnp.shape(const)) > LARGEST:
        return id(const)
    array = np.asarray(const)
    return array.dtype.name, array.shape, array.tobytes()


def _small_ones(leaves: list[Any], large: Any) -> list[Any]:
    return [leaf for leaf, is_large in zip(leaves, large, strict=True) if not is_large]


def _as_it_is(*leaves: Any, program: ClosedJaxpr, **_: Any) -> list[Any]:
    return jaxpr_as_fun(program)(*leaves)


def _lowered(ctx: Any, *leaves: Any, **params: Any) -> Any:
    """As function where one device runs it: the compiler may put what several tell each other anywhere
    into a program that is theirs, and a function cannot."""
    run = _as_function if is_of_one_device(ctx.module_context.axis_context) else _as_it_is
    return mlir.lower_fun(run, multiple_results=True)(ctx, *leaves, **params)


def _as_function(*leaves: Any, program: ClosedJaxpr, large: Any, **_: Any) -> list[Any]:
    """As one function where it is small, as several where a loop can be divided."""
    if not is_small(program):
        return jaxpr_as_fun(divided(program))(*leaves)
    few = _small_ones(list(leaves), large)
    if not few:
        # As a derivative in nothing that it was made of.
        return jaxpr_as_fun(program)(*leaves)
    like = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in few]
    program, numbers = handed_over(program)
    row = in_a_row(numbers)

    def call(vector: jax.Array, many: list[Any]) -> tuple[list[Any], list[Any]]:
        *own, at_last = unpacked(vector, [*like, row])
        small, rest = iter(own), iter(many)
        whole = [next(rest if is_large else small) for is_large in large]
        return jaxpr_as_fun(summed_by_parts(program))(*unpacked(at_last, numbers), *whole), [
            leaf.ravel()[0] for leaf in (vector, *many)
        ]

    many = [leaf for leaf, is_large in zip(leaves, large, strict=True) if is_large]
    # Something computed goes along with the small ones: all constant, they would be a long constant.
    return as_one(call, packed([*few, row, *(leaf.ravel()[:1] for leaf in many)]), many)[0]


_one_p = Primitive("one_function")
_one_p.multiple_results = True
_one_p.def_impl(lambda *leaves, **params: jax.jit(partial(_as_it_is, **params))(*leaves))
_one_p.def_abstract_eval(lambda *leaves, program, **_: program.out_avals)
mlir.register_lowering(_one_p, mlir.lower_fun(_as_it_is, multiple_results=True))
mlir.register_lowering(_one_p, _lowered, platform="cpu", cacheable=False)


def _batched(
    leaves: Any, axes: Any, *, program: ClosedJaxpr, large: Any, otherwise: Any
) -> tuple[Any, Any]:
    whole = jax.vmap(otherwise or jaxpr_as_fun(program), in_axes=tuple(axes))
    found = whole(*leaves) if otherwise else _called(whole, list(leaves), list(large))
    return found, [0] * len(found)


def _pushed_forward(
    leaves: Any, tangents: Any, *, program: ClosedJaxpr, large: Any, otherwise: Any
) -> tuple[Any, Any]:
    """A derivative is a program of its own, small or not, in what moves alone; the values are not taken
    from it, since they may be known, or the same for many directions, where it is not."""
    moves = [not isinstance(t, ad.Zero) and t.dtype != jax.dtypes.float0 for t in tangents]
    count = len(leaves)

    def push(*given: Any) -> list[Any]:
        start = given[:count]

        def of(*moving: Any) -> list[Any]:
            own = iter(moving)
            return (otherwise or jaxpr_as_fun(program))(
                *(next(own) if m else leaf for leaf, m in zip(start, moves, strict=True))
            )

        moving = tuple(leaf for leaf, m in zip(start, moves, strict=True) if m)
        pushed = jax.jvp(of, moving, given[count:])[1]
        return [t for t in pushed if t.dtype != jax.dtypes.float0]

    pick = lambda values: _those(values, moves)  # noqa: E731
    out = _one_p.bind(*leaves, program=program, large=large, otherwise=otherwise)
    given = [*leaves, *pick(tangents)]
    found = iter(push(*given) if otherwise else _called(push, given, [*large, *pick(large)]))
    zero: Any = ad.Zero
    pushed = [
        next(found)
        if jnp.issubdtype(leaf.dtype, jnp.inexact)
        else zero(jax.typeof(leaf).to_tangent_aval())
        for leaf in out
    ]
    return out, pushed


def _of_use(used: list[bool], *given: Any) -> tuple[list[bool], Any]:
    """Dead-code elimination rule; JAX passes (used, eqn), from 0.12 on (used, live inputs, eqn)."""
    eqn = given[-1]
    if not any(used):
        return [False] * len(eqn.invars), None
    large, otherwise = eqn.params["large"], eqn.params["otherwise"]
    other = otherwise and (lambda *given: _those(otherwise(*given), used))
    # What is otherwise done may lead there from other inputs.
    jaxpr, needed = pe.dce_jaxpr(eqn.params["program"].jaxpr, used, instantiate=bool(otherwise))
    params = {
        "program": ClosedJaxpr(jaxpr, ()), "large": tuple(_those(large, needed)), "otherwise": other
    }  # fmt: skip
    new = new_jaxpr_eqn(
        _those(eqn.invars, needed), _those(eqn.outvars, used), eqn.primitive, params, eqn.effects,
        eqn.source_info, eqn.ctx,
    )  # fmt: skip
    return needed, new


def _those(values: Any, wanted: list[bool]) -> list[Any]:
    return [value for value, is_wanted in zip(values, wanted, strict=True) if is_wanted]


batching.primitive_batchers[_one_p] = _batched
ad.primitive_jvps[_one_p] = _pushed_forward
pe.dce_rules[_one_p] = _of_use
