"""The values that the functions of a problem read from around them: closures, globals, defaults, and
attributes of objects.

A compiled program contains the values that f, h, K, A and P read when they were traced. So that a value
that has changed since is not missed, a problem is used as `current(problem)`: its functions compare as
equal only if what they read is equal. Values in args do not need this, and change without another
compilation. Functions that are made again, by another call of the function that defines them, are
equal if their code and what they read are: they share a compiled program.
"""

import dis
import functools
import hashlib
import sys
import types
import weakref
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np

from . import _tree
from ._once import once_per_object
from .errors import input_error

_LIBRARIES = frozenset(
    {"dvax", "equinox", "jax", "jaxlib", "jaxtyping", "numpy", "scipy", "optimistix", "builtins"}
) | set(sys.stdlib_module_names)
"""Packages whose functions read nothing that a user changes."""

_DEPTH = 6
"""Levels of containers, objects and functions that are looked into."""

_MAX_ENTRIES = 10_000
"""Largest container whose entries are compared one by one."""

_MAX_VERSIONS = 16

Part = TypeVar("Part")


class _Same:
    """A key of an object that is compared by identity, and kept alive so that no other one has it."""

    def __init__(self, one: Any):
        self.one = one

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.one is self.one

    def __hash__(self) -> int:
        return id(self.one)


class _Code:
    """A key of a function without what it reads, which has keys of its own."""

    def __init__(self, fn: types.FunctionType):
        self.fn = fn

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Code) and _is_same_code(self.fn, other.fn)

    def __hash__(self) -> int:
        return hash(self.fn.__code__)


_VALUES = (bool, int, float, complex, str, bytes, type(None), np.ndarray, np.generic)
"""Types whose keys are their values."""


def _is_same_code(fn: Any, other: Any, depth: int = _DEPTH) -> bool:
    """Return whether two functions differ at most in values that have keys: their code is the same, and
    so are the objects in their closures and defaults."""
    if fn is other:
        return True
    if depth == 0 or not (type(fn) is type(other) is types.FunctionType):
        return False
    if fn.__globals__ is not other.__globals__ or fn.__code__ != other.__code__:
        return False
    if fn.__dict__ or other.__dict__:
        return False
    try:
        mine, others = (
            (
                [cell.cell_contents for cell in f.__closure__ or ()],
                list(f.__defaults__ or ()),
                sorted((f.__kwdefaults__ or {}).items()),
            )
            for f in (fn, other)
        )
    except ValueError:  # a variable of the closure is not assigned yet
        return False
    return _have_same_objects(mine, others, depth - 1)


def _have_same_objects(one: Any, other: Any, depth: int) -> bool:
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, _VALUES):
        return not getattr(one, "dtype", np.dtype(float)).hasobject
    if isinstance(one, dict):
        return one.keys() == other.keys() and _have_same_objects(
            list(one.values()), [other[key] for key in one], depth
        )
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(
            _have_same_objects(a, b, depth) for a, b in zip(one, other, strict=True)
        )
    return _is_same_code(one, other, depth)


_WRITTEN: Any = weakref.WeakKeyDictionary()
"""The places of what functions change themselves when they are called, such as a list of their calls:
it is no input, and every call would make another program."""


def _written(fn: Any) -> frozenset[int]:
    try:
        return _WRITTEN.get(fn, frozenset())
    except TypeError:
        return frozenset()  # an object without weak references


def _without_written(fn: Any, key: tuple[Any, ...]) -> tuple[Any, ...]:
    written = _written(fn)
    return key if not written else tuple(pair for pair in key if pair[0] not in written)


class _Captured:
    """A function with the key of what it reads: pairs of a place and the value there."""

    def __init__(self, fn: Callable[..., Any], key: tuple[Any, ...]):
        functools.update_wrapper(self, fn, updated=())
        self.fn, self.key = fn, key

    def __call__(self, *args: Any) -> Any:
        before = dict(_of_function(self.fn, _DEPTH, frozenset()))
        value = self.fn(*args)
        after = dict(_of_function(self.fn, _DEPTH, frozenset()))
        if after != before:
            changed = {place for place in before if after.get(place) != before[place]}
            _WRITTEN[self.fn] = _written(self.fn) | changed
        return value

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Captured):
            return False
        if other.fn != self.fn and not _is_same_code(other.fn, self.fn):
            return False
        return _without_written(self.fn, other.key) == _without_written(self.fn, self.key)

    def __hash__(self) -> int:
        return hash(getattr(self.fn, "__code__", self.fn))

    def __repr__(self) -> str:
        return repr(self.fn)

    def __reduce__(self) -> tuple[Any, ...]:
        return _itself, (self.fn,)


def _itself(fn: Any) -> Any:
    return fn


def current(part: Part) -> Part:
    """Return a problem whose functions are distinguished by the values that they read now: the same
    object as long as these are equal."""
    places = _functions(part) if isinstance(part, eqx.Module) else ()
    if not places:
        return part
    keys = tuple(_of_function(fn, _DEPTH, frozenset()) for _, fn in places)
    versions = _versions(part)
    found = versions.get(keys)
    if found is None:
        if len(versions) >= _MAX_VERSIONS:
            versions.clear()
        leaves, tree = jtu.tree_flatten(part)
        for (place, fn), key in zip(places, keys, strict=True):
            leaves[place] = _Captured(fn, key)
        found = versions[keys] = jtu.tree_unflatten(tree, leaves)
    return found


class Reads:
    """The code of a problem of `current`, its arrays, and the values that its functions read, to be
    compared with those of others. Arrays that are traced count as equal to all."""

    def __init__(self, part: Any):
        leaves, self.structure = jtu.tree_flatten(part)
        captured = [v for v in leaves if isinstance(v, _Captured)]
        self.functions: tuple[Any, ...] = tuple(v for v in captured if v.key or _written(v.fn))
        self.rest: tuple[Any, ...] | None = tuple(captured)
        self.arrays = tuple(_kept(v) for v in leaves if not isinstance(v, _Captured))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Reads) or other.functions != self.functions:
            return False
        if self.rest is None or other.rest is None:
            return True  # one of them was stored, and code is not
        if self.rest != other.rest or self.structure != other.structure:
            return False
        return all(map(_are_equal, self.arrays, other.arrays))

    def __hash__(self) -> int:
        return hash(self.functions)

    def __reduce__(self) -> tuple[Any, ...]:
        return _stored, (bool(self.functions),)


def _kept(value: Any) -> Any:
    return value.copy() if isinstance(value, np.ndarray) else value


def _are_equal(one: Any, other: Any) -> bool:
    if not _tree.is_concrete(one, other):
        return True
    if _tree.is_key(one) and _tree.is_key(other):
        one, other = map(jax.random.key_data, (one, other))
    if eqx.is_array_like(one) and eqx.is_array_like(other):
        return np.shape(one) == np.shape(other) and bool(np.array_equal(one, other))
    return bool(one == other)


def _stored(is_known: bool) -> Reads:
    """Return what was read before it was stored: values are not stored, and equal no others."""
    found = Reads(None)
    found.rest = None
    found.functions = (_Same(object()),) if is_known else ()
    return found


def require_unchanged(part: Any, place: str) -> None:
    """Refuse to read functions of a problem of `current` again after what they read has changed.

    **Raises:** `dvax.InputError`.
    """
    for leaf in jtu.tree_leaves(part):
        if not isinstance(leaf, _Captured):
            continue
        if _Captured(leaf.fn, _of_function(leaf.fn, _DEPTH, frozenset())) != leaf:
            raise input_error(
                place,
                "a function of the problem that reads other values now than in the run",
                "this result is computed from f, h and K when it is first asked for, and what they "
                "read from around them (a global, a closure, an attribute) has changed",
                "Pass values that change in args, or ask for the result before they change",
            )


@once_per_object
def _functions(part: Any) -> tuple[tuple[int, Any], ...]:
    """Return the functions of the user among the leaves, with their places."""
    found = enumerate(jtu.tree_leaves(part))
    return tuple((k, leaf) for k, leaf in found if callable(leaf) and _is_own(leaf))


@once_per_object
def _versions(part: Any) -> dict[Any, Any]:
    """Return a table of the versions of a problem, by the keys of its functions."""
    return {}


def _is_own(one: Any) -> bool:
    """Return whether a function or an object is not one of a library, and none with a key already."""
    if isinstance(one, _Captured):
        return False
    kind = one if isinstance(one, types.FunctionType | types.MethodType) else type(one)
    if isinstance(one, functools.partial | types.SimpleNamespace):
        return True
    return str(getattr(kind, "__module__", "")).split(".")[0] not in _LIBRARIES


@functools.lru_cache(1024)
def _is_installed(module: str) -> bool:
    """Return whether a module is one of an installed package, whose objects may hold large graphs of
    others."""
    file = getattr(sys.modules.get(module), "__file__", None) or ""
    return "site-packages" in file or "dist-packages" in file


class _Names(NamedTuple):
    """The names of globals and of attributes that code reads, with the functions defined in it."""

    around: frozenset[str]
    attributes: frozenset[str]


@functools.lru_cache(1024)
def _names(code: types.CodeType) -> _Names:
    around, attributes = set(), set()
    for step in dis.get_instructions(code):
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            around.add(step.argval)
        elif step.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            attributes.add(step.argval)
    for inner in (_names(c) for c in code.co_consts if isinstance(c, types.CodeType)):
        around |= inner.around
        attributes |= inner.attributes
    return _Names(frozenset(around), frozenset(attributes))


@functools.lru_cache(1024)
def _attributes_read(kind: type, names: frozenset[str]) -> frozenset[str]:
    """Return the attributes that code with these names of attributes reads of objects of a class, by
    itself and by the methods that it calls."""
    found, ahead = set(names), list(names)
    while ahead:
        method = getattr(kind, ahead.pop(), None)
        method = getattr(method, "fget", method)
        if isinstance(method, types.FunctionType):
            more = _names(method.__code__).attributes - found
            found |= more
            ahead += more
    return frozenset(found)


def _of_function(fn: Any, depth: int, seen: frozenset[int]) -> tuple[Any, ...]:
    """Return pairs of a place and the key of what a function reads there, empty if it reads nothing
    that may change."""
    if depth == 0 or id(fn) in seen:
        return ()
    keys = enumerate(_keys_of_function(fn, depth, seen | {id(fn)}))
    return _without_written(fn, tuple((k, key) for k, key in keys if key is not None))


def _keys_of_function(fn: Any, depth: int, seen: frozenset[int]) -> tuple[Hashable, ...]:
    """Return the keys of what a function reads, in an order that does not change."""
    if isinstance(fn, functools.partial):
        inner = fn.func if isinstance(fn.func, types.FunctionType) else None
        names = _names(inner.__code__).attributes if inner else frozenset[str]()
        parts = list(fn.args), fn.keywords
        return *(_key(v, depth, seen, names) for v in parts), *_of_function(fn.func, depth, seen)
    if isinstance(fn, types.MethodType):
        names = frozenset([fn.__func__.__name__])
        return _key(fn.__self__, depth, seen, names), *_of_function(fn.__func__, depth, seen)
    if not isinstance(fn, types.FunctionType):
        call = getattr(type(fn), "__call__", None)  # noqa: B004 (the code of its calls is wanted)
        own = _of_function(call, depth, seen) if isinstance(call, types.FunctionType) else ()
        return _key(fn, depth, seen - {id(fn)}, frozenset(["__call__"])), *own
    values = []
    for cell in fn.__closure__ or ():
        try:
            values.append(cell.cell_contents)
        except ValueError:
            continue  # not assigned yet
    values += fn.__defaults__ or ()
    values += (fn.__kwdefaults__ or {}).values()
    names, around = _names(fn.__code__), fn.__globals__
    for name in sorted(names.around):
        value = around.get(name)
        if isinstance(value, types.ModuleType):
            if value.__name__.split(".")[0] not in _LIBRARIES:
                values += [vars(value)[n] for n in sorted(names.attributes) if n in vars(value)]
        elif name in around:
            values.append(value)
    return tuple(_key(value, depth - 1, seen, names.attributes) for value in values)


def _key(value: Any, depth: int, seen: frozenset[int], names: frozenset[str]) -> Hashable:
    """Return a key of a value, None if it cannot change. `names` are those of attributes that are
    read."""
    kind = type(value)
    if value is None or kind in (bool, int, str, bytes, complex):
        return kind, value
    if kind is float:
        return kind, value.hex()  # NaN equals itself, and 0.0 is not -0.0
    if isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
        if array.dtype.hasobject:
            return _Same(value)
        digest = hashlib.blake2b(np.ascontiguousarray(array).data, digest_size=16).digest()
        return kind, array.shape, str(array.dtype), digest
    if isinstance(value, types.ModuleType) or not _tree.is_concrete(value):
        return None
    if id(value) in seen:
        return None
    if isinstance(value, jax.Array) or depth == 0:
        return _Same(value)
    seen = seen | {id(value)}
    inside = functools.partial(_key, depth=depth - 1, seen=seen, names=names)
    if isinstance(value, list | tuple | set | frozenset) and len(value) <= _MAX_ENTRIES:
        return kind, tuple(map(inside, value))
    if isinstance(value, dict) and len(value) <= _MAX_ENTRIES:
        return kind, tuple((inside(k), inside(v)) for k, v in value.items())
    if isinstance(value, eqx.Module):
        functions = _functions(value)
        return _Same(value), *(_of_function(fn, depth - 1, seen) for _, fn in functions)
    is_function = isinstance(value, types.FunctionType | types.MethodType | functools.partial)
    if not _is_own(value) or isinstance(value, type):
        return None if is_function else _Same(value)
    if is_function:
        own = _Code(value) if isinstance(value, types.FunctionType) else _Same(value)
        return own, _of_function(value, depth, seen - {id(value)})
    if callable(to_numpy := getattr(value, "to_numpy", None)):
        return _Same(value), inside(to_numpy())
    if _is_installed(kind.__module__):
        return _Same(value)
    try:
        attributes = vars(value)
    except TypeError:
        return _Same(value)
    read = _attributes_read(kind, names)
    found = ((n, inside(v)) for n, v in attributes.items() if n in read)
    return _Same(value), tuple(found)
