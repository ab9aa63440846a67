"""The last few results by their keys."""

from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Recent(Generic[Value]):
    """At most `most` values; the one that was used longest ago is dropped first."""

    def __init__(self, most: int):
        self._most, self._values = most, OrderedDict[Hashable, Value]()

    def get(self, key: Hashable) -> Value | None:
        """Return the value of this key, None where there is none."""
        if key in self._values:
            self._values.move_to_end(key)
        return self._values.get(key)

    def put(self, key: Hashable, value: Value) -> Value:
        """Keep the value, and return it."""
        self._values[key] = value
        self._values.move_to_end(key)
        while len(self._values) > self._most:
            self._values.popitem(last=False)
        return value
