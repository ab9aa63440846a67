"""Small programs as one function of the processor, on JAX 0.10 and 0.11.

Those releases compile a program for a CPU to a list of kernels, and to call one takes longer than the
arithmetic on a few numbers. XLA can compile a call as one function instead, and does so of its own
accord for the smallest loops. Two attributes request it where a program is known to be small.

From JAX 0.12 on XLA does this itself; there, on other devices, and wherever an interface that this
file needs is absent, programs go to XLA as they are. The file can go with the support of Python 3.11,
whose last JAX is 0.10.2.
"""

import math
from collections.abc import Callable
from functools import partial
from itertools import compress
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.lax import GatherScatterMode

_LARGEST = 8192
"""Entries of an array that is computed: for more, several cores are worth more than few kernels."""

_LARGEST_REDUCED = 2048
"""The same of a reduction: XLA reduces longer arrays by calls of a library, which one function cannot
contain."""

_LARGEST_COSTLY = 500
"""The same for functions that cost many times as much as a product."""

_LARGEST_MATRIX = 5
"""Rows of a matrix that is multiplied by a matrix: larger products are calls of a library as well."""

_MAX_PACKED = 10**6
"""Entries of all arguments together."""

_PACKABLE = tuple(map(np.dtype, "bool int32 int64 uint32 float32 float64".split()))

_OTHERS = frozenset(
    "abs add add_any and bitcast_convert_type ceil clamp concatenate convert_element_type "
    "copy div eq expand_dims floor ge gt integer_pow iota is_finite le lt max "
    "min mul ne neg nextafter not or pad rem reshape rev round rsqrt select_n shift_left "
    "shift_right_arithmetic shift_right_logical sign slice split sqrt square squeeze stack sub "
    "transpose xor".split()
)
_REDUCTIONS = "argmax argmin reduce_and reduce_max reduce_min reduce_or reduce_sum".split()
_COSTLY = frozenset(
    "acos acosh asin asinh atan atan2 atanh cbrt cos cosh erf exp exp2 expm1 log log1p logistic pow "
    "sin sinh tan tanh".split()
)
_PARTS = {"dynamic_slice": None, "gather": None, "dynamic_update_slice": 1, "scatter": 2}
"""Operations on a part of an array, which itself may be of any size. The part is the result (None) or
the argument of this number."""
_FREE = ("broadcast_in_dim", "stop_gradient", "reshard")
_NESTED = frozenset(
    "jit pjit closed_call custom_jvp_call custom_vjp_call custom_vmap_call remat2 cond scan "
    "while".split()
)


def outlined(run: Callable[..., Any], *args: Any, large: Any = ()) -> Any:
    """Return run(*args, *large), compiled as one function where the program is small.

    The arrays in `large` may be of any size. A batch of the program is outlined in turn; its tangents
    are not.
    """
    if jax.default_backend() != "cpu":
        return run(*args, *large)
    arrays, static = eqx.partition((args, large), eqx.is_array)
    leaves, tree = jtu.tree_flatten(arrays)
    packs = [k < len(jtu.tree_leaves(arrays[0])) for k in range(len(leaves))]
    others: list[Any] = []

    def dynamic(*leaves: Any) -> Any:
        args, large = eqx.combine(tree.unflatten(leaves), static)
        out, other = eqx.partition(run(*args, *large), eqx.is_array)
        others.append(other)
        return out

    program, shape = jax.make_jaxpr(dynamic, return_shape=True)(*leaves)
    found = jtu.tree_structure(shape).unflatten(_bind(program, leaves, packs))
    return eqx.combine(found, others[0])


def _bind(program: ClosedJaxpr, leaves: list[Any], packs: list[bool]) -> list[Any]:
    """Return the results of a program, as one function where it is small."""
    jaxpr = program.jaxpr
    leaves, packs = [*program.consts, *leaves], [True] * len(program.consts) + packs
    invars, names = [*jaxpr.constvars, *jaxpr.invars], jaxpr.debug_info.with_unknown_names()
    program = ClosedJaxpr(jaxpr.replace(constvars=[], invars=invars, debug_info=names), ())
    packed = list(compress(leaves, packs))
    numbers = all(leaf.dtype in _PACKABLE for leaf in packed)
    if not (
        numbers and 0 < sum(leaf.size for leaf in packed) <= _MAX_PACKED and _is_small(program)
    ):
        return jaxpr_as_fun(program)(*leaves)
    return _outlined_p.bind(*leaves, program=program, packs=tuple(packs))


# Which programs are small, and made of what one function can do: asking for one that cannot be
# compiled so is an error that no program can catch.


def _is_small(program: ClosedJaxpr) -> bool:
    return _are_few(program.consts) and all(map(_is_small_equation, program.jaxpr.eqns))


def _are_few(arrays: Any, most: int = _LARGEST) -> bool:
    return all(math.prod(jnp.shape(array)) <= most for array in arrays)


def _is_small_equation(eqn: Any) -> bool:
    name, results = eqn.primitive.name, [v.aval for v in eqn.outvars]
    if name in _NESTED:
        return all(map(_is_small, _nested_programs(eqn.params)))
    if name in _PARTS:
        place = _PARTS[name]
        part = results[0] if place is None else eqn.invars[place].aval
        # XLA compiles a scatter so only where it writes one row, the same for a whole batch.
        row = name != "scatter" or (
            math.prod(eqn.invars[1].aval.shape[:-1]) == 1
            and eqn.params["mode"] == GatherScatterMode.CLIP
        )
        return row and _are_few([part])
    if name in _COSTLY:
        return _are_few(results, _LARGEST_COSTLY)
    if name == "dot_general":
        return _is_plain_product(eqn, *(v.aval for v in eqn.invars))
    if name in _REDUCTIONS:
        return _are_few([eqn.invars[0].aval], _LARGEST_REDUCED)
    return name in _FREE or (name in _OTHERS and _are_few(results))


def _nested_programs(params: dict[str, Any]) -> list[ClosedJaxpr]:
    found = []
    for value in params.values():
        for one in value if isinstance(value, tuple | list) else (value,):
            if isinstance(one, ClosedJaxpr | Jaxpr):
                found.append(one if isinstance(one, ClosedJaxpr) else ClosedJaxpr(one, ()))
    return found


def _is_plain_product(eqn: Any, first: Any, second: Any) -> bool:
    """Return whether it is of a real matrix and a vector, or of two tiny matrices."""
    batched = eqn.params["dimension_numbers"][1] != ((), ())
    real = first.dtype == second.dtype and jnp.issubdtype(first.dtype, jnp.floating)
    if batched or not real or max(first.ndim, second.ndim) > 2:
        return False
    tiny = max(*first.shape, *second.shape, 0) <= _LARGEST_MATRIX
    return tiny if first.ndim == second.ndim == 2 else _are_few([first, second])


# The arguments are packed into one array: XLA aborts on arguments of an outlined call that turn out to
# be unused or constant, and every argument costs time at each call.


def _pack(leaf: Any) -> jax.Array:
    """Return an array as floating numbers, bit by bit where it holds integers."""
    leaf, wide = jnp.asarray(leaf), jnp.result_type(float)
    if leaf.dtype.kind != "f":
        leaf = jax.lax.bitcast_convert_type(leaf.astype(jnp.result_type(int)), wide)
    return leaf.astype(wide).ravel()


def _unpack(vector: jax.Array, like: list[Any]) -> list[jax.Array]:
    leaves, start = [], 0
    for one in like:
        part = vector[start : start + one.size].reshape(one.shape)
        if one.dtype.kind != "f":
            part = jax.lax.bitcast_convert_type(part, jnp.result_type(int))
        leaves.append(part.astype(one.dtype))
        start += one.size
    return leaves


def _as_it_is(*leaves: Any, program: ClosedJaxpr, packs: Any) -> list[Any]:
    return jaxpr_as_fun(program)(*leaves)


def _as_function(*leaves: Any, program: ClosedJaxpr, packs: Any) -> list[Any]:
    few, many = list(compress(leaves, packs)), list(compress(leaves, [not p for p in packs]))
    like = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in few]

    def call(vector: jax.Array, many: list[Any]) -> tuple[list[Any], list[Any]]:
        small, rest = iter(_unpack(vector, like)), iter(many)
        whole = [next(small if p else rest) for p in packs]
        # What is returned is used.
        return jaxpr_as_fun(program)(*whole), [leaf.ravel()[0] for leaf in (vector, *many)]

    # An entry of each large array goes along, since the vector itself may turn out to be constant.
    vector = jnp.concatenate([_pack(leaf) for leaf in (*few, *(m.ravel()[:1] for m in many))])
    attributes = {"inlineable": "false", "xla_cpu_small_call": "true"}
    marked: Any = set_xla_metadata(jax.jit(call)(vector, many), **attributes)
    return marked[0]


def _lower(ctx: Any, *leaves: Any, **params: Any) -> Any:
    """Outline a program that one device runs. XLA may put the communication between several anywhere
    into a program that is theirs, and one function cannot hold it."""
    context = ctx.module_context.axis_context
    if isinstance(context, mlir.ShardingContext):
        alone = context.num_devices == 1
    else:
        alone = context.manual_axes == frozenset(context.mesh.axis_names)
    run = _as_function if alone else _as_it_is
    return mlir.lower_fun(run, multiple_results=True)(ctx, *leaves, **params)


def _batch(leaves: Any, axes: Any, *, program: ClosedJaxpr, packs: Any) -> Any:
    whole = jax.vmap(jaxpr_as_fun(program), in_axes=tuple(axes))
    found = _bind(jax.make_jaxpr(whole)(*leaves), list(leaves), list(packs))
    return found, [0] * len(found)


def _push_forward(leaves: Any, tangents: Any, *, program: ClosedJaxpr, packs: Any) -> Any:
    """Return values and tangents by a plain program, which can be linearised and transposed."""
    moves = [not isinstance(tangent, ad.Zero) for tangent in tangents]

    def of(*moving: Any) -> list[Any]:
        own = iter(moving)
        whole = [next(own) if m else leaf for leaf, m in zip(leaves, moves, strict=True)]
        return jaxpr_as_fun(program)(*whole)

    out, pushed = jax.jvp(of, tuple(compress(leaves, moves)), tuple(compress(tangents, moves)))
    zeros = [ad.Zero(jax.typeof(v).to_tangent_aval()) for v in out]
    none = [t.dtype == jax.dtypes.float0 for t in pushed]
    return out, [zero if n else t for zero, n, t in zip(zeros, none, pushed, strict=True)]


_outlined_p = Primitive("outlined")
_outlined_p.multiple_results = True
_outlined_p.def_impl(lambda *leaves, **params: jax.jit(partial(_as_it_is, **params))(*leaves))
_outlined_p.def_abstract_eval(lambda *leaves, program, **_: program.out_avals)
mlir.register_lowering(_outlined_p, mlir.lower_fun(_as_it_is, multiple_results=True))
mlir.register_lowering(_outlined_p, _lower, platform="cpu", cacheable=False)
batching.primitive_batchers[_outlined_p] = _batch
ad.primitive_jvps[_outlined_p] = _push_forward
