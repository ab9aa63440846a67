"""Values that depend on an immutable object alone, computed once per object."""

import weakref
from collections.abc import Callable
from typing import Any, TypeVar

Value = TypeVar("Value")


def once_per_object(compute: Callable[[Any], Value]) -> Callable[[Any], Value]:
    """Return `compute` with its values kept for as long as their arguments live.

    Objects are distinguished by identity, so they must be immutable; a module with arrays could not be
    compared by value without looking at all entries.
    """
    kept: dict[int, tuple[weakref.ref[Any], Value]] = {}

    def get(one: Any) -> Value:
        key = id(one)
        entry = kept.get(key)
        if entry is not None and entry[0]() is one:
            return entry[1]
        value = compute(one)
        kept[key] = weakref.ref(one, lambda _: kept.pop(key, None)), value
        return value

    return get
