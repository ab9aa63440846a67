"""Values that are computed once per object."""

import gc

from dvax._once import once_per_object


class _Object:
    pass


def test_value_is_computed_once_per_object_and_forgotten_with_it():
    calls = []

    @once_per_object
    def number(one):
        calls.append(id(one))
        return len(calls)

    first, second = _Object(), _Object()
    assert [number(first), number(second), number(first)] == [1, 2, 1]
    del first
    gc.collect()
    # The address of the first object may be used again.
    fresh = [_Object() for _ in range(100)]
    assert [number(one) for one in fresh] == list(range(3, 103))
