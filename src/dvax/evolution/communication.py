"""`dvax.communication`: what devices send each other in a step of a sharded state."""

import math
from collections import Counter
from typing import Any, NamedTuple

import jax

from .. import _tree
from .._jax.collectives import collectives
from .._tree import Tree
from ..errors import input_error
from ..problem import Problem
from .arguments import Arguments
from .compiled import compiled_text
from .loop import STEP
from .method import AbstractMethod
from .solve import prepared


class Collective(NamedTuple):
    """Collective operations of one kind.

    - `kind`: "all-reduce", "all-gather", "all-to-all", "collective-permute", …;
    - `count`: how many; `bytes`: of the results of all of them on one device;
    - `optional`: a branch or a loop within a step contains them, so that a step may run them never or
      more than once.

    ```python
    >>> from dvax.evolution import Collective
    >>> sums = Collective("all-reduce", count=2, bytes=16, optional=False)
    >>> sums.kind, sums.count, sums.bytes
    ('all-reduce', 2, 16)

    ```
    """

    kind: str
    count: int
    bytes: int
    optional: bool

    def sent(self, devices: int) -> float:
        """Return the bytes that a device sends, by the usual algorithm on a ring of devices."""
        others = (devices - 1) / devices
        shares = {
            "all-reduce": 2 * others,
            "collective-permute": 1.0,
            "reduce-scatter": devices * others,
        }
        return self.bytes * shares.get(self.kind, others)

    def hops(self, devices: int) -> int:
        """Return how many messages follow each other."""
        rounds = {"all-reduce": 2 * math.ceil(math.log2(devices)), "collective-permute": 1}
        return self.count * rounds.get(self.kind, devices - 1)


class Communication(NamedTuple):
    """The collective operations of one attempted `step`, those outside the loop over steps (`once`),
    and the number of `devices`. As text it is a table.

    ```python
    >>> from dvax.evolution import Collective, Communication
    >>> sums = Collective("all-reduce", count=2, bytes=16, optional=False)
    >>> print(Communication(devices=8, step=(sums,), once=()))
             operation            count  bytes on a device
    step     all-reduce               2                 16

    ```
    """

    devices: int
    step: tuple[Collective, ...]
    once: tuple[Collective, ...]

    def seconds(self, bandwidth: float, latency: float) -> float:
        """Return the time of the communication of a step in seconds, Σ (sent/bandwidth + hops·latency),
        for a bandwidth in bytes/s and a latency in s; each optional operation counts once."""
        return sum(
            one.sent(self.devices) / bandwidth + one.hops(self.devices) * latency
            for one in self.step
        )

    def __str__(self) -> str:
        lines = [f"{'':9}{'operation':20}{'count':>6}{'bytes on a device':>19}"]
        for name, rows in (("step", self.step), ("once", self.once)):
            for row in rows:
                note = "  in a branch or a loop" if row.optional else ""
                lines.append(f"{name:9}{row.kind:20}{row.count:>6}{row.bytes:>19}{note}")
        return "\n".join(lines)


def communication(
    problem: Problem,
    x0: Tree,
    t0: Any,
    t1: Any,
    args: Any = None,
    ts: Any = None,
    *,
    dt: Any = None,
    rtol: Any = 1e-6,
    atol: Any = 1e-9,
    method: AbstractMethod | None = None,
    dense: bool = False,
) -> Communication:
    """Return the collective operations of `dvax.solve` with these arguments, counted in its program.

    The program is compiled, as `dvax.solve` compiles it, and not run. A pointwise law needs
    all-reduces of a few numbers; an all-gather whose bytes are those of the state says that f, h, K or
    A needs the whole state on each device.

    **Arguments:** as in `dvax.solve`; x0 must be sharded over several devices.

    **Raises:** `dvax.InputError` for a state on one device, and for methods that are not compiled to
    one loop over steps (`Implicit`, `Picard`, `PiecewiseLinear`).

    ```python
    >>> import dvax, jax, jax.numpy as jnp
    >>> from jax.sharding import Mesh, NamedSharding, PartitionSpec
    >>> mesh = Mesh(jax.devices(), ("points",))                              # doctest: +SKIP
    >>> x0 = jax.device_put(x0, NamedSharding(mesh, PartitionSpec("points")))  # doctest: +SKIP
    >>> print(dvax.communication(problem, x0, 0.0, 1.0))                     # doctest: +SKIP

    ```
    """
    if method is not None and not isinstance(method, AbstractMethod):
        raise input_error(
            "dvax.communication(method)", type(method).__name__,
            "its program is not one loop over steps",
            "Choose a method such as dvax.ETD2RK(), or omit it for the default",
        )  # fmt: skip
    call = Arguments(problem, x0, t0, t1, args, ts, dt, rtol, atol, method, dense=dense)
    setup, times, options = prepared(call)
    leaves = jax.tree_util.tree_leaves(setup.x0)
    devices = max(len(leaf.sharding.device_set) for leaf in leaves if _tree.is_concrete(leaf))
    if devices == 1:
        raise input_error(
            "dvax.communication(x0)", "a state on one device", "only several devices communicate",
            'Shard it: jax.device_put(x0, NamedSharding(mesh, PartitionSpec("points")))',
        )  # fmt: skip
    found = collectives(compiled_text(setup, times, options), STEP)
    inside = _counted([(one.kind, one.optional, one.bytes) for one in found if one.in_step])
    once = _counted([(one.kind, False, one.bytes) for one in found if not one.in_step])
    return Communication(devices, inside, once)


def _counted(found: list[tuple[str, bool, int]]) -> tuple[Collective, ...]:
    count, size = Counter[tuple[str, bool]](), Counter[tuple[str, bool]]()
    for kind, optional, bytes_ in found:
        count[kind, optional] += 1
        size[kind, optional] += bytes_
    return tuple(Collective(*key[:1], n, size[key], key[1]) for key, n in sorted(count.items()))
