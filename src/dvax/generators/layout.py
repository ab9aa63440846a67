"""The layout of an array that is sharded over several devices, and its change for a transform.

A device can transform an axis only if it has the whole of it. The shards of this axis are therefore
moved to another axis before its transform, by one all-to-all, as in the slab and pencil decompositions
of parallel Fourier transforms. XLA's partitioner gathers the argument of every Fourier transform,
sharded or not along its axis; in `jax.shard_map` each device transforms what it has.
"""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec

Spec = tuple[tuple[str, ...], ...]
"""For each axis of an array the axes of the mesh that divide it."""

WHOLE: Spec = ((),)
"""The spec of a vector that each device has the whole of."""


class Move(NamedTuple):
    """The layout for the transform of one axis: `spec` and the padded `shape`; and the spec and the
    shape before the shards of this axis moved to another one."""

    axis: int
    spec: Spec
    shape: tuple[int, ...]
    old_spec: Spec
    old_shape: tuple[int, ...]


class Layout(NamedTuple):
    """A mesh of devices, and the spec of the state on it."""

    mesh: Mesh
    spec: Spec

    @staticmethod
    def of(sharding: NamedSharding, axes: int) -> "Layout | None":
        """Return the layout of an array with this sharding, or None if no axis is divided."""
        assert isinstance(sharding.mesh, Mesh)
        entries = [*sharding.spec, *(None,) * (axes - len(sharding.spec))]
        names = [(e,) if isinstance(e, str) else tuple(e or ()) for e in entries]
        layout = Layout(sharding.mesh, tuple(names))
        return layout if any(layout.shards(k) > 1 for k in names) else None

    def shards(self, names: tuple[str, ...]) -> int:
        """Return into how many shards these axes of the mesh divide an axis."""
        return math.prod(self.mesh.shape[name] for name in names)

    def constrain(self, x: jax.Array, spec: Spec | None = None) -> jax.Array:
        """Return x, sharded by `spec`, by default that of the state."""
        partition = _partition(self.spec if spec is None else spec)
        return jax.lax.with_sharding_constraint(x, NamedSharding(self.mesh, partition))

    def locally(self, run: Callable[[jax.Array], jax.Array], x: jax.Array, spec: Spec) -> jax.Array:
        """Return run(x), computed by each device from its part of x."""
        partition = _partition(spec)
        return jax.shard_map(run, mesh=self.mesh, in_specs=partition, out_specs=partition)(x)

    def moves(self, shape: tuple[int, ...], axes: Iterable[tuple[int, int]]) -> list[Move]:
        """Return the moves for pairs of an axis and the size that its transform gives it: the shards of
        this axis go to the one with the fewest."""
        spec, sizes, found = list(self.spec), list(shape), []
        for axis, size in axes:
            old_spec, old_shape = tuple(spec), tuple(sizes)
            others = [k for k in range(len(spec)) if k != axis]
            if spec[axis]:
                to = min(others, key=lambda k: len(spec[k]))
                spec[to] = spec[to] + spec[axis]
                spec[axis] = ()
                sizes[to] += -sizes[to] % self.shards(spec[to])
            found.append(Move(axis, tuple(spec), tuple(sizes), old_spec, old_shape))
            sizes[axis] = size
        return found


def padded(x: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Return x with zeros behind its entries, up to this shape."""
    widths = [(0, size - n) for n, size in zip(x.shape, shape, strict=True)]
    return jnp.pad(x, widths) if any(width for _, width in widths) else x


def _partition(spec: Spec) -> PartitionSpec:
    return PartitionSpec(*(names or None for names in spec))
