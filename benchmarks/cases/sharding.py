"""One state on several devices: the communication of a step, and the time on one and on two devices.

The number of devices is settled before JAX starts, so that each row is measured by a process of its own
with as many host devices, which share the cores of this machine.
"""

import json
import os
import subprocess
import sys

from ..section import Section, Table

_STEPS = 20


def run(full: bool) -> Section:
    section = Section(
        title="sharding: one state on several devices",
        fair=(
            "Collective operations of one step, counted in the program that dvax.solve compiles for "
            "eight devices, with the bytes of their results on one device. Times are those of a step "
            f"in runs of {_STEPS} fixed steps of ETD2RK, the best of five, on one and on two host "
            "devices. XLA divides the work of one host device among all cores, so that two devices "
            "on two cores can gain nothing: the ratio shows what the partition costs."
        ),
    )
    sizes = (10**5, 10**6, 10**7) if full else (10**5, 10**6)
    counted, timed = [], []
    for name in NAMES:
        for row in _child(8, "count", name, sizes[:1]):
            counted.append((name, *row))
        one, two = (_child(devices, "time", name, sizes) for devices in (1, 2))
        for (n, alone), (_, shared) in zip(one, two, strict=True):
            timed.append((name, f"{n:,}", _ms(alone), _ms(shared), f"{shared / alone:.2f}"))
    header = ("problem", "steps", "operation", "count", "bytes on a device")
    section.tables.append(Table(f"one step, 8 devices, n ≈ {sizes[0]:,}", header, counted))
    header = ("problem", "n", "1 device", "2 devices", "ratio")
    section.tables.append(Table("time of a step", header, timed))
    return section


NAMES = ("diagonal", "line", "plane")


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"


def _child(devices: int, task: str, name: str, sizes: tuple[int, ...]) -> list:
    flag = f"--xla_force_host_platform_device_count={devices}"
    flags = f"{os.environ.get('XLA_FLAGS', '')} {flag}"
    arguments = [sys.executable, "-m", __name__, task, name, json.dumps(sizes)]
    done = subprocess.run(
        arguments,
        env={**os.environ, "XLA_FLAGS": flags},
        check=True,
        capture_output=True,
        text=True,
    )
    return json.loads(done.stdout)


def _measured(task: str, name: str, sizes: list[int]) -> list:
    import time

    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax.sharding import Mesh, NamedSharding, PartitionSpec

    import dvax

    jax.config.update("jax_enable_x64", True)
    sharding = NamedSharding(Mesh(np.array(jax.devices()), ("points",)), PartitionSpec("points"))

    def given(n: int) -> tuple:
        side = 8 * round(n**0.5 / 8)
        shape = (side, side) if name == "plane" else (8 * (n // 8),)
        v = jax.device_put(np.linspace(0.0, 1.0, int(np.prod(shape))).reshape(shape), sharding)
        A = dvax.generators.Diagonal(-1.0 - v)
        if name != "diagonal":
            A = dvax.generators.Elliptic(shape, 1.0, "neumann", 1e-3)
        problem = dvax.Problem(
            A=A, P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.4),
            f=lambda t, x, u, args: jnp.exp(-t) * args - 0.2 * x - u,
            h=lambda t, x, u, args: 1.0 - 1.5 * x - 0.5 * u,
        )  # fmt: skip
        return problem, v, 0.0, 1.0, v

    def step(n: int) -> float:
        arguments, taken = given(n), []
        for _ in range(6):
            start = time.perf_counter()
            sol = dvax.solve(*arguments, dt=1.0 / _STEPS)
            jax.block_until_ready(sol.xs)
            taken.append((time.perf_counter() - start) / _STEPS)
        return min(taken[1:])

    if task == "time":
        return [(n, step(n)) for n in sizes]
    rows = []
    for steps, options in (("fixed", {"dt": 1.0 / _STEPS}), ("adaptive", {})):
        found = dvax.communication(*given(sizes[0]), **options)
        rows += [(steps, one.kind, str(one.count), f"{one.bytes:,}") for one in found.step]
        rows += [] if found.step else [(steps, "none", "0", "0")]
    return rows


if __name__ == "__main__":
    print(json.dumps(_measured(sys.argv[1], sys.argv[2], json.loads(sys.argv[3]))))
