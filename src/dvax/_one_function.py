"""Small programs as one function of the processor.

On a CPU, XLA runs a program as a list of kernels, and to call one takes longer than the arithmetic on
a handful of numbers. It can compile a program as one function instead, and does so of its own accord
for the tiniest of loops. The two attributes below ask for the same where a program is known to be
small.

Not every operation can be compiled so (library calls cannot, nor what XLA hands to its own libraries
for matrices), and asking for one that cannot is an error that no program can catch once it is part of
a larger one. So programs are looked through, and only what is known to work is asked for.
"""

import functools
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
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive, Var, jaxpr_as_fun, new_jaxpr_eqn
from jax.interpreters import ad, batching, mlir
from jax.interpreters import partial_eval as pe
from jax.lax import GatherScatterMode

_ATTRIBUTES = {"inlineable": "false", "xla_cpu_small_call": "true"}

_LONGEST = 10**6
"""Entries of all that is handed over: tables, of which a part at a time is read."""
_LARGEST = 8192
"""Entries of an array that is computed: for a larger one, cores are worth more than few kernels."""
_COSTLY = 500
"""The same, of a function that costs many times as much as a product."""
_SUMMED = 2048
"""Entries of an array that is reduced: of larger ones XLA makes calls of a library."""
_SIDE = 5
"""Of a matrix that a matrix is multiplied by: larger ones are calls of a library as well."""

_ENTRYWISE = frozenset(
    "abs add add_any and ceil clamp complex conj convert_element_type copy div eq floor ge gt imag "
    "integer_pow is_finite le lt max min mul ne neg nextafter not or real rem round rsqrt select_n "
    "shift_left shift_right_arithmetic shift_right_logical sign sqrt square bitcast_convert_type sub "
    "xor any_of_batch largest_of_batch own_turn zeros_of_batch".split()
)
_FUNCTIONS = frozenset(
    "acos acosh asin asinh atan atan2 atanh cbrt cos cosh erf exp exp2 expm1 log log1p logistic pow "
    "sin sinh tan tanh".split()
)
_MOVES = frozenset(
    "concatenate expand_dims iota pad reshape rev slice split squeeze stack transpose".split()
)
_PLACES = {"dynamic_slice": None, "gather": None, "dynamic_update_slice": 1, "scatter": 2}
"""These touch a part of an array, which may be as large as it likes: the part is what comes out, or the
argument of this number."""
_MEMORY = frozenset("broadcast_in_dim stop_gradient".split())
"""How arrays begin that are then filled part by part, and what does nothing."""
_SUMS = frozenset(
    "argmax argmin reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum".split()
)
_CONTROL = frozenset(
    "cond while scan jit pjit closed_call custom_jvp_call custom_vjp_call remat2".split()
)


def in_one_function(
    run: Callable[..., Any],
    *args: Any,
    computed: Any = (),
    otherwise: Callable[..., Any] | None = None,
) -> Any:
    """run(*args, *computed), compiled as one function where it is small and this is a CPU. What another
    such function has `computed` may be as large as it likes.

    A batch of it and its derivatives are such functions too; unless there is another way to the same
    result, which is then taken `otherwise`, and can be transposed."""
    arrays, static = eqx.partition((args, computed), eqx.is_array)
    leaves, tree = jtu.tree_flatten(arrays)
    large = [False] * len(jtu.tree_leaves(arrays[0])) + [True] * len(jtu.tree_leaves(arrays[1]))
    if not (_available() and _can_pack(_small_ones(leaves, large))):
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
    is_one = _can_pack(_small_ones(whole, large)) and _is_small(opened)
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
    if isinstance(const, Tracer) or math.prod(jnp.shape(const)) > _LARGEST:
        return id(const)
    array = np.asarray(const)
    return array.dtype.name, array.shape, array.tobytes()


def _small_ones(leaves: list[Any], large: Any) -> list[Any]:
    return [leaf for leaf, is_large in zip(leaves, large, strict=True) if not is_large]


def _as_it_is(*leaves: Any, program: ClosedJaxpr, **_: Any) -> list[Any]:
    return jaxpr_as_fun(program)(*leaves)


def _as_one(*leaves: Any, program: ClosedJaxpr, large: Any, **_: Any) -> list[Any]:
    """The call with its attributes. The compiler stops at an argument that turns out to be of no use,
    or at a long one that turns out to be constant: so the small ones are packed into one, and an entry
    of it and of each of the large ones is returned."""
    few = _small_ones(list(leaves), large)
    if not few:
        # As a derivative in nothing that it was made of.
        return jaxpr_as_fun(program)(*leaves)
    like = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in few]

    def call(packed: jax.Array, many: list[Any]) -> tuple[list[Any], list[Any]]:
        small, rest = iter(_unpacked(packed, like)), iter(many)
        whole = [next(rest if is_large else small) for is_large in large]
        return jaxpr_as_fun(program)(*whole), [leaf.ravel()[0] for leaf in (packed, *many)]

    many = [leaf for leaf, is_large in zip(leaves, large, strict=True) if is_large]
    # Something computed goes along with the small ones: all constant, they would be a long constant.
    packed = _packed([*few, *(leaf.ravel()[:1] for leaf in many)])
    marked: Any = set_xla_metadata(jax.jit(call)(packed, many), **_ATTRIBUTES)
    return marked[0]


_one_p = Primitive("one_function")
_one_p.multiple_results = True
_one_p.def_impl(lambda *leaves, **params: jax.jit(partial(_as_it_is, **params))(*leaves))
_one_p.def_abstract_eval(lambda *leaves, program, **_: program.out_avals)
mlir.register_lowering(_one_p, mlir.lower_fun(_as_it_is, multiple_results=True))
mlir.register_lowering(
    _one_p, mlir.lower_fun(_as_one, multiple_results=True), platform="cpu", cacheable=False
)


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


def _of_use(used: list[bool], eqn: Any) -> tuple[list[bool], Any]:
    """Without the outputs that nobody looks at, and what leads to them alone."""
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


def _can_pack(leaves: list[Any]) -> bool:
    known = all(leaf.dtype == bool or jnp.issubdtype(leaf.dtype, jnp.number) for leaf in leaves)
    return known and 0 < sum(leaf.size for leaf in leaves) <= _LONGEST


def _packed(leaves: list[Any]) -> jax.Array:
    """All of them as one array of floating numbers."""
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


def _few(arrays: list[Any], most: int = _LARGEST) -> bool:
    return all(math.prod(jnp.shape(array)) <= most for array in arrays)


def _is_small(program: ClosedJaxpr) -> bool:
    return _few(program.consts) and all(map(_is_known, program.jaxpr.eqns))


def _is_known(eqn: Any) -> bool:
    name = eqn.primitive.name
    if name in _CONTROL:
        return all(map(_is_small, _inner(eqn.params)))
    if name in _MEMORY:
        return True
    if name in _PLACES:
        place = _PLACES[name]
        part = eqn.outvars[0] if place is None else eqn.invars[place]
        return _few([part.aval]) and (name != "scatter" or _is_one_place(eqn))
    if not _few([v.aval for v in eqn.outvars]):
        return False
    if name == "dot_general":
        return _is_plain_product(eqn)
    if name in _SUMS:
        return math.prod(eqn.invars[0].aval.shape) <= _SUMMED
    if name in _FUNCTIONS:
        return _few([v.aval for v in eqn.outvars], _COSTLY)
    return name in _ENTRYWISE or name in _MOVES


def _is_one_place(eqn: Any) -> bool:
    """A row that is written into the same place for all of a batch: of scatters only this can be
    compiled so, since XLA takes it for what it was."""
    indices = eqn.invars[1].aval.shape
    return math.prod(indices[:-1]) == 1 and eqn.params["mode"] == GatherScatterMode.CLIP


def _is_plain_product(eqn: Any) -> bool:
    """A matrix and a vector of real numbers, or two tiny matrices."""
    first, second = (v.aval for v in eqn.invars)
    if eqn.params["dimension_numbers"][1] != ((), ()) or first.dtype != second.dtype:
        return False
    if not jnp.issubdtype(first.dtype, jnp.floating) or max(first.ndim, second.ndim) > 2:
        return False
    if min(first.ndim, second.ndim) < 2:
        return _few([first, second])
    return max(*first.shape, *second.shape) <= _SIDE


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

    def probe(v: jax.Array) -> Any:
        return set_xla_metadata(
            jax.jit(lambda v: jax.lax.fori_loop(0, 3, turn, v))(v), **_ATTRIBUTES
        )

    with jax.ensure_compile_time_eval():
        try:
            jax.jit(probe)(jnp.ones(4)).block_until_ready()
        except jax.errors.JaxRuntimeError:
            return False
    return True
