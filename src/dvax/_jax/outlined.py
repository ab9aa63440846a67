"""Compilation of small programs as one CPU function, on JAX 0.10 and 0.11.

These releases compile a program for the CPU to a list of kernels, and a kernel call takes longer than
arithmetic on a few numbers. XLA can compile a call as one function instead; by default it does so for
the smallest loops only. Two attributes request it for programs that are known to be small.

From JAX 0.12 on XLA does this by default. There, on other devices, and if an interface is missing,
programs are not outlined. Remove this file with the support of Python 3.11, whose last JAX is 0.10.2.
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
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.lax import GatherScatterMode

from .jaxprs import count_operations, nested_programs

_MAX_ENTRIES = 8192
"""Largest number of entries of a computed array: larger arrays gain more from several cores."""

_MAX_REDUCED = 2048
"""The same for the argument of a reduction: XLA reduces longer arrays by library calls, which one
function cannot contain."""

_MAX_COSTLY = 500
"""The same for functions that cost many times as much as a product."""

_MAX_MATRIX = 5
"""Largest number of rows in a product of two matrices: larger products are library calls too."""

_MAX_EQUATIONS = 15_000
"""Largest number of operations: the compile time of one function grows faster than its length (18 000
operations take 21 s, and as separate kernels 7 s)."""

_MAX_PACKED = 10**6
"""Largest number of entries of all packed arguments together."""

_PACKABLE = tuple(map(np.dtype, "bool int32 int64 uint32 float32 float64".split()))

_ELEMENTWISE = frozenset(
    "abs add add_any and bitcast_convert_type ceil clamp concatenate convert_element_type "
    "copy div eq expand_dims floor ge gt integer_pow iota is_finite le le_to lt lt_to max "
    "min mul ne neg nextafter not or pad reduce_precision rem reshape rev round rsqrt "
    "select_n shift_left shift_right_arithmetic shift_right_logical sign slice split sqrt square "
    "squeeze stack sub transpose xor".split()
)
_REDUCTIONS = "argmax argmin reduce_and reduce_max reduce_min reduce_or reduce_sum".split()
_COSTLY = frozenset(
    "acos acosh asin asinh atan atan2 atanh cbrt cos cosh erf exp exp2 expm1 log log1p logistic pow "
    "sin sinh tan tanh".split()
)
_PARTS = {"dynamic_slice": None, "gather": None, "dynamic_update_slice": 1, "scatter": 2}
"""Operations on a part of an array of any size. The part is the result (None), or the argument of this
number."""
_FREE = ("broadcast_in_dim", "stop_gradient", "reshard", "empty2")
_NESTED = frozenset(
    "custom_linear_solve jit pjit closed_call custom_jvp_call custom_vjp_call custom_vmap_call remat2 "
    "cond scan while".split()
)


def outlined(run: Callable[..., Any], *args: Any, large: Any = ()) -> Any:
    """Return run(*args, *large), compiled as one function if the program is small.

    The arrays in `large` may be of any size. Under `jax.vmap` the batched program is outlined too;
    tangents are not outlined.
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
    results = jtu.tree_structure(shape).unflatten(_bind(program, leaves, packs))
    return eqx.combine(results, others[0])


def _bind(program: ClosedJaxpr, leaves: list[Any], packs: list[bool]) -> list[Any]:
    """Return the results of a program, outlined if it is small."""
    jaxpr = program.jaxpr
    leaves, packs = [*program.consts, *leaves], [True] * len(program.consts) + packs
    invars, names = [*jaxpr.constvars, *jaxpr.invars], jaxpr.debug_info.with_unknown_names()
    program = ClosedJaxpr(jaxpr.replace(constvars=[], invars=invars, debug_info=names), ())
    packed = list(compress(leaves, packs))
    numbers = all(leaf.dtype in _PACKABLE for leaf in packed)
    if not (
        numbers
        and 0 < sum(leaf.size for leaf in packed) <= _MAX_PACKED
        and _is_small(program)
        and count_operations(program) <= _MAX_EQUATIONS
    ):
        return jaxpr_as_fun(program)(*leaves)
    return _outlined_p.bind(*leaves, program=program, packs=tuple(packs))


# The following functions decide which programs are small and contain only operations that XLA can
# compile in one function. A request for another program aborts the process.


def _is_small(program: ClosedJaxpr) -> bool:
    return _are_few(program.consts) and all(map(_is_small_equation, program.jaxpr.eqns))


def _are_few(arrays: Any, most: int = _MAX_ENTRIES) -> bool:
    return all(math.prod(jnp.shape(array)) <= most for array in arrays)


def _is_small_equation(eqn: Any) -> bool:
    name, results = eqn.primitive.name, [v.aval for v in eqn.outvars]
    if name in _NESTED:
        return all(map(_is_small, nested_programs(eqn.params)))
    if name in _PARTS:
        number = _PARTS[name]
        part = results[0] if number is None else eqn.invars[number].aval
        # XLA supports only a scatter that writes one row, the same for a whole batch.
        is_supported = name != "scatter" or (
            math.prod(eqn.invars[1].aval.shape[:-1]) == 1
            and eqn.params["mode"] == GatherScatterMode.CLIP
        )
        return is_supported and _are_few([part])
    if name in _COSTLY:
        return _are_few(results, _MAX_COSTLY)
    if name == "dot_general":
        return _is_plain_product(eqn, *(v.aval for v in eqn.invars))
    if name in _REDUCTIONS:
        return _are_few([eqn.invars[0].aval], _MAX_REDUCED)
    return name in _FREE or (name in _ELEMENTWISE and _are_few(results))


def _is_plain_product(eqn: Any, first: Any, second: Any) -> bool:
    """Return whether a product is that of a real matrix and a vector, or of two tiny matrices."""
    batched = eqn.params["dimension_numbers"][1] != ((), ())
    real = first.dtype == second.dtype and jnp.issubdtype(first.dtype, jnp.floating)
    if batched or not real or max(first.ndim, second.ndim) > 2:
        return False
    tiny = max(*first.shape, *second.shape, 0) <= _MAX_MATRIX
    return tiny if first.ndim == second.ndim == 2 else _are_few([first, second])


# Pack the arguments into one array: XLA aborts on arguments of an outlined call that are unused or
# constant, and every argument costs time at each call.


def _pack(leaf: Any) -> jax.Array:
    """Return an array as a floating-point vector; integers are converted bitwise."""
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


def _call_plainly(*leaves: Any, program: ClosedJaxpr, packs: Any) -> list[Any]:
    return jaxpr_as_fun(program)(*leaves)


def _call_outlined(*leaves: Any, program: ClosedJaxpr, packs: Any) -> list[Any]:
    packed, large = list(compress(leaves, packs)), list(compress(leaves, [not p for p in packs]))
    like = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in packed]

    def call(vector: jax.Array, large: list[Any]) -> tuple[list[Any], list[Any]]:
        small, rest = iter(_unpack(vector, like)), iter(large)
        whole = [next(small if p else rest) for p in packs]
        # Return an entry of each argument, so that none is unused.
        return jaxpr_as_fun(program)(*whole), [leaf.ravel()[0] for leaf in (vector, *large)]

    # Pack an entry of each large array too, since the vector might be constant otherwise.
    vector = jnp.concatenate([_pack(leaf) for leaf in (*packed, *(m.ravel()[:1] for m in large))])
    attributes = {"inlineable": "false", "xla_cpu_small_call": "true"}
    marked: Any = set_xla_metadata(jax.jit(call)(vector, large), **attributes)
    return marked[0]


def _lower(ctx: Any, *leaves: Any, **params: Any) -> Any:
    """Lower a program, outlined if it runs on one device.

    With several devices, XLA may insert communication, which one function cannot contain.
    """
    context = ctx.module_context.axis_context
    if isinstance(context, mlir.ShardingContext):
        is_on_one_device = context.num_devices == 1
    else:
        is_on_one_device = context.manual_axes == frozenset(context.mesh.axis_names)
    run = _call_outlined if is_on_one_device else _call_plainly
    return mlir.lower_fun(run, multiple_results=True)(ctx, *leaves, **params)


def _batch(leaves: Any, axes: Any, *, program: ClosedJaxpr, packs: Any) -> Any:
    batched = jax.vmap(jaxpr_as_fun(program), in_axes=tuple(axes))
    results = _bind(jax.make_jaxpr(batched)(*leaves), list(leaves), list(packs))
    return results, [0] * len(results)


def _jvp(leaves: Any, tangents: Any, *, program: ClosedJaxpr, packs: Any) -> Any:
    """Return values and tangents by a plain program, which can be linearised and transposed."""
    has_tangent = [not isinstance(tangent, ad.Zero) for tangent in tangents]

    def run(*differentiated: Any) -> list[Any]:
        own = iter(differentiated)
        inputs = [next(own) if d else leaf for leaf, d in zip(leaves, has_tangent, strict=True)]
        return jaxpr_as_fun(program)(*inputs)

    primals = tuple(compress(leaves, has_tangent))
    out, out_tangents = jax.jvp(run, primals, tuple(compress(tangents, has_tangent)))
    zeros = [ad.Zero(jax.typeof(v).to_tangent_aval()) for v in out]
    is_zero = [t.dtype == jax.dtypes.float0 for t in out_tangents]
    return out, [zero if n else t for zero, n, t in zip(zeros, is_zero, out_tangents, strict=True)]


_outlined_p = Primitive("outlined")
_outlined_p.multiple_results = True
_outlined_p.def_impl(lambda *leaves, **params: jax.jit(partial(_call_plainly, **params))(*leaves))
_outlined_p.def_abstract_eval(lambda *leaves, program, **_: program.out_avals)
mlir.register_lowering(_outlined_p, mlir.lower_fun(_call_plainly, multiple_results=True))
mlir.register_lowering(_outlined_p, _lower, platform="cpu", cacheable=False)
batching.primitive_batchers[_outlined_p] = _batch
ad.primitive_jvps[_outlined_p] = _jvp
