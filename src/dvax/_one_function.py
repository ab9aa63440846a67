"""Small programs as one function of the processor.

On a CPU, XLA runs a program as a list of kernels, and calling one costs fifty nanoseconds and more:
longer than the arithmetic on a handful of numbers takes. It can compile a program as one function
instead, and does so of its own accord for loops that touch less than a kilobyte. The two attributes
below ask for the same where a program is known to be small: a step of a small system then takes a
tenth of the time, and its loop half as long to compile.

Not every operation can be compiled so (library calls cannot, nor what XLA hands to its own libraries
for matrices), and asking for one that cannot is an error that no program can catch once it is part of
a larger one. So programs are looked through, and only what is known to work is asked for.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive
from jax.interpreters import ad, batching, mlir

_ATTRIBUTES = {"inlineable": "false", "xla_cpu_small_call": "true"}

_LARGEST = 1000
"""Entries of an array that is computed or handed over. A larger one that turns out to be constant stops
the compiler; and several cores are then worth more than few kernels."""
_SUMMED = 2048
"""Entries of an array that is reduced: of larger ones XLA makes calls of a library."""
_VECTOR, _MATRIX = _LARGEST, 5
"""Entries of a matrix that a vector is multiplied by; sides of one that a matrix is, larger ones being
calls of a library as well."""

_ENTRYWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp complex conj "
    "convert_element_type copy cos cosh div eq erf exp exp2 expm1 floor ge gt imag integer_pow "
    "is_finite le log log1p logistic lt max min mul ne neg nextafter not or pow real rem round rsqrt "
    "select_n shift_left shift_right_arithmetic shift_right_logical sign sin sinh sqrt square "
    "bitcast_convert_type stop_gradient sub tan tanh xor any_of_batch largest_of_batch".split()
)
_MOVES = frozenset(
    "broadcast_in_dim concatenate expand_dims iota pad reshape rev slice split squeeze stack "
    "transpose".split()
)
_PLACES = frozenset("dynamic_slice dynamic_update_slice gather".split())
"""These touch a part of an array, which may be as large as it likes."""
_SUMS = frozenset(
    "argmax argmin reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum".split()
)
_CONTROL = frozenset(
    "cond while scan jit pjit closed_call custom_jvp_call custom_vjp_call remat2".split()
)


def in_one_function(run: Callable[..., Any], *args: Any, computed: Any = ()) -> Any:
    """run(*args, *computed), compiled as one function where it is small and this is a CPU. What is
    `computed` by another such function, and surely used, may be as large as it likes."""
    arrays, static = eqx.partition(args, eqx.is_array)
    leaves, tree = jtu.tree_flatten(arrays)
    if not (_available() and _can_pack(leaves)):
        return run(*args, *computed)
    like = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
    rest: list[Any] = []

    def flat(packed: jax.Array, computed: Any) -> Any:
        arrays = jtu.tree_unflatten(tree, _unpacked(packed, like))
        out, kept = eqx.partition(run(*eqx.combine(arrays, static), *computed), eqx.is_array)
        rest.append(kept)
        return out

    call, packed = jax.jit(flat), _packed(leaves)
    program = call.trace(packed, computed).jaxpr
    small = _is_small(program)
    out = call(packed, computed)
    if small:
        plain = not _has_rules(program.jaxpr)
        out = jtu.tree_map(lambda leaf: _mark_p.bind(leaf, plain=plain), out)
    return eqx.combine(out, rest[0])


def _marked(value: jax.Array, *, plain: bool) -> jax.Array:
    """The value, with the attributes on the call that it comes from."""
    marked: Any = set_xla_metadata(value, **_ATTRIBUTES)
    return marked


_mark_p = Primitive("one_function")
_mark_p.def_impl(lambda value, *, plain: value)
_mark_p.def_abstract_eval(lambda value, *, plain: value)
mlir.register_lowering(_mark_p, mlir.lower_fun(_marked, multiple_results=False), cacheable=False)
# What a batch makes of a program has not been looked through.
batching.primitive_batchers[_mark_p] = lambda given, axes, *, plain: (given[0], axes[0])


def _differentiated(given: Any, tangents: Any, *, plain: bool) -> tuple[Any, Any]:
    """A derivative takes more operations of the same kinds, unless somebody has made a rule for one."""
    return (_mark_p.bind(*given, plain=True) if plain else given[0]), tangents[0]


ad.primitive_jvps[_mark_p] = _differentiated


def _has_rules(jaxpr: Jaxpr) -> bool:
    """Whether derivatives somewhere are not those of the operations themselves."""
    return any(
        eqn.primitive.name in ("custom_jvp_call", "custom_vjp_call")
        or any(_has_rules(inner.jaxpr) for inner in _inner(eqn.params))
        for eqn in jaxpr.eqns
    )


def _can_pack(leaves: list[Any]) -> bool:
    known = all(leaf.dtype == bool or jnp.issubdtype(leaf.dtype, jnp.number) for leaf in leaves)
    return known and 0 < sum(leaf.size for leaf in leaves) <= _LARGEST


def _packed(leaves: list[Any]) -> jax.Array:
    """All of them as one array of floating numbers, since the compiler stops at an argument that turns
    out to be of no use, or at a large one that turns out to be constant."""
    return jnp.concatenate([_as_floating(leaf).ravel() for leaf in leaves])


def _as_floating(leaf: Any) -> jax.Array:
    leaf, wide = jnp.asarray(leaf), jnp.result_type(float)
    if jnp.iscomplexobj(leaf):
        return jnp.stack([jnp.real(leaf), jnp.imag(leaf)]).astype(wide)
    if jnp.issubdtype(leaf.dtype, jnp.floating):
        return leaf.astype(wide)
    return jax.lax.bitcast_convert_type(leaf.astype(jnp.result_type(int)), wide)


def _unpacked(packed: jax.Array, like: list[Any]) -> list[jax.Array]:
    leaves, start = [], 0
    for shape, dtype in ((part.shape, part.dtype) for part in like):
        count = math.prod(shape) * (2 if jnp.issubdtype(dtype, jnp.complexfloating) else 1)
        part, start = packed[start : start + count], start + count
        if jnp.issubdtype(dtype, jnp.complexfloating):
            leaf = jax.lax.complex(*part.reshape(2, *shape)).astype(dtype)
        elif jnp.issubdtype(dtype, jnp.floating):
            leaf = part.reshape(shape).astype(dtype)
        else:
            whole = jax.lax.bitcast_convert_type(part, jnp.result_type(int))
            leaf = whole.reshape(shape).astype(dtype)
        leaves.append(leaf)
    return leaves


def _few(arrays: list[Any]) -> bool:
    return all(math.prod(jnp.shape(array)) <= _LARGEST for array in arrays)


def _is_small(program: ClosedJaxpr) -> bool:
    return _few(program.consts) and all(map(_is_known, program.jaxpr.eqns))


def _is_known(eqn: Any) -> bool:
    name = eqn.primitive.name
    if name in _CONTROL:
        return all(map(_is_small, _inner(eqn.params)))
    if name == "broadcast_in_dim" and not eqn.invars[0].aval.shape:
        return True  # how arrays begin that are then filled part by part
    if name in _PLACES:
        part = eqn.invars[1] if name == "dynamic_update_slice" else eqn.outvars[0]
        return _few([part.aval])
    if not _few([v.aval for v in eqn.outvars]):
        return False
    if name == "dot_general":
        return _is_plain_product(eqn)
    if name in _SUMS:
        return math.prod(eqn.invars[0].aval.shape) <= _SUMMED
    return name in _ENTRYWISE or name in _MOVES


def _is_plain_product(eqn: Any) -> bool:
    """A matrix and a vector of real numbers, or two tiny matrices."""
    first, second = (v.aval for v in eqn.invars)
    if eqn.params["dimension_numbers"][1] != ((), ()) or first.dtype != second.dtype:
        return False
    if not jnp.issubdtype(first.dtype, jnp.floating) or max(first.ndim, second.ndim) > 2:
        return False
    if min(first.ndim, second.ndim) < 2:
        return max(math.prod(first.shape), math.prod(second.shape)) <= _VECTOR
    return max(*first.shape, *second.shape) <= _MATRIX


def _inner(params: dict[str, Any]) -> list[ClosedJaxpr]:
    """The programs that an operation holds."""
    found = []
    for value in params.values():
        for one in value if isinstance(value, tuple | list) else (value,):
            if isinstance(one, ClosedJaxpr):
                found.append(one)
            elif isinstance(one, Jaxpr):
                found.append(ClosedJaxpr(one, ()))
    return found


def _available() -> bool:
    return jax.default_backend() == "cpu" and _compiles()


@functools.cache
def _compiles() -> bool:
    """Whether this XLA compiles a loop with a branch and a product so."""

    def turn(k: Any, v: jax.Array) -> jax.Array:
        v = jax.lax.cond(v[0] > 1.0, lambda: 0.5 * v, lambda: jnp.flip(v) + v[k])
        return jnp.outer(v, v) @ v / jnp.sum(jnp.exp(v))

    def probe(v: jax.Array) -> jax.Array:
        return _mark_p.bind(jax.jit(lambda v: jax.lax.fori_loop(0, 3, turn, v))(v), plain=True)

    with jax.ensure_compile_time_eval():
        try:
            jax.jit(probe)(jnp.ones(4)).block_until_ready()
        except jax.errors.JaxRuntimeError:
            return False
    return True
