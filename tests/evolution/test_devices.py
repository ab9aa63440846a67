"""Sharding of a field, or of the runs of a batch, over several devices does not change the results."""

import subprocess
import sys
import textwrap

import pytest
from tests.selection import mostly_thorough

PROGRAM = """
    import os
    # Beside the flags of the tests, with which XLA compiles faster.
    os.environ["XLA_FLAGS"] = (
        os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    )
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax.sharding import AxisType, NamedSharding, PartitionSpec
    jax.config.update("jax_enable_x64", True)
    import dvax

    mesh = jax.make_mesh((2,), ("devices",), axis_types=(AxisType.Auto,))
    spec = PartitionSpec("devices")
    shared = NamedSharding(mesh, spec)
    s = (jnp.arange(64.0) + 0.5) * (jnp.pi / 64)
    law = dict(P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.4))
    field = dvax.Problem(
        A=dvax.generators.Elliptic(64, jnp.pi, boundary="dirichlet"),
        f=lambda t, x, u, args: jnp.exp(-t) * jnp.sin(s) - 0.2 * x - u,
        h=lambda t, x, u, args: 1.0 - 1.5 * x - 0.5 * u, **law,
    )
    scalar = dvax.Problem(
        A=dvax.generators.Scalar(-0.5), f=lambda t, x, u, args: jnp.sin(3.0 * t) - u,
        h=lambda t, x, u, args: 1.0 - 1.5 * x - 0.5 * u, **law,
    )

    def end(problem, **steps):
        return lambda x0: dvax.solve(problem, x0, 0.0, 1.0, method=dvax.ETD2RK(), **steps).xs[-1]

    def gradient(run):
        return jax.grad(lambda x0: jnp.sum(run(x0) ** 2))

    def apart(run):
        return jax.shard_map(run, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)

    lanes, starts = jax.vmap(end(scalar, rtol=1e-6)), jnp.linspace(-1.0, 1.0, 6)
    fixed, adaptive = end(field, dt=1 / 256), end(field, rtol=1e-6)
    # Roundoff decides which of the adaptive steps at the kinks of a field is rejected: a change of x0
    # by 1e-16 changes their number and, by a hundredth of the tolerance, the end.
    cases = {
        "a field": (fixed, fixed, jnp.sin(s), False, 1e-12),
        "its gradient": (gradient(fixed), gradient(fixed), s, False, 1e-12),
        "a field in adaptive steps": (adaptive, adaptive, jnp.sin(s), False, 1e-7),
        "their gradient": (gradient(adaptive), gradient(adaptive), s, False, 1e-7),
        "a batch": (lanes, lanes, starts, False, 1e-9),
        "a batch on each": (apart(lanes), lanes, starts, True, 1e-9),
    }
    for run, alike, x0, is_one, rtol in (cases[name] for name in NAMES):
        program = jax.jit(run).lower(jax.device_put(x0, shared)).compile()
        found = program(jax.device_put(x0, shared))
        assert found.sharding.device_set == set(jax.devices())
        assert ("xla_cpu_small_call" in program.as_text()) == is_one
        np.testing.assert_allclose(found, jax.jit(alike)(x0), rtol=rtol, atol=1e-12)
"""


CASES = [
    ["a batch", "a batch on each"],
    ["a field", "its gradient", "a field in adaptive steps", "their gradient"],
]


@pytest.mark.thorough
@pytest.mark.parametrize("names", mostly_thorough(CASES, CASES[:1]))
def test_sharded_solve_equals_the_solve_on_one_device(names):
    program = textwrap.dedent(PROGRAM).replace("NAMES", repr(names))
    subprocess.run([sys.executable, "-c", program], check=True)
