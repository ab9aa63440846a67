"""Solves without outlined programs (`dvax._jax`): on newer JAX, and without the interfaces that
outlined programs need, all results and derivatives are the same."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax import _jax
from dvax.evolution import responses, reverse, steps

problem = dvax.Problem(
    A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    f=lambda t, x, u, args: args - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
)  # fmt: skip


def end(load, **how):
    return dvax.solve(problem, -1.0, 0.0, 2.0, args=load, **how).xs[-1]


FIXED = dict(dt=0.01, method=dvax.ETD4RK())
TIGHT = dict(rtol=1e-9, atol=1e-9)
WAYS = {
    "fixed": (lambda load: end(load, **FIXED), 1e-13),
    "adaptive": (lambda load: end(load, **TIGHT), 1e-8),
    "grad": (jax.grad(lambda load: end(load, **TIGHT)), 1e-7),
    "jvp": (
        lambda load: jax.jvp(lambda a: end(a, adjoint="forward", **FIXED), (load,), (1.0,)), 1e-12,
    ),
    "linearize": (
        lambda load: jax.linearize(lambda a: end(a, adjoint="forward", **FIXED), load)[1](1.0), 1e-12,
    ),
    "vmap": (lambda load: jax.vmap(lambda a: end(a, **FIXED))(load + jnp.arange(3.0)), 1e-13),
}  # fmt: skip


def by(monkeypatch, call):
    """Let every solve call its programs through `call`."""
    for module in (responses, reverse, steps):
        monkeypatch.setattr(module, "outlined", call)
    jax.clear_caches()


@pytest.fixture(scope="module")
def usual():
    return {name: way(3.0) for name, (way, _) in WAYS.items()}


@pytest.mark.thorough
def test_plain_programs_give_the_same_solutions_and_derivatives(usual, monkeypatch):
    by(monkeypatch, _jax._plain)
    for name, (way, apart) in WAYS.items():
        jax.tree_util.tree_map(
            lambda a, b, name=name, apart=apart: np.testing.assert_allclose(
                a, b, rtol=apart, atol=apart, err_msg=name
            ),
            way(3.0),
            usual[name],
        )
    jax.clear_caches()


@pytest.mark.slow
def test_outlined_and_plain_solution_is_the_closed_form(usual):
    # x is saturated up to ln(1.6)/1.5, in contact for 2 ln(10/9), and free from then on.
    free = 2.0 - np.log(1.6) / 1.5 - 2.0 * np.log(10 / 9)
    assert float(usual["adaptive"]) == pytest.approx(2.0 - 1.5 * np.exp(-1.5 * free), abs=1e-8)
    assert float(usual["grad"]) == pytest.approx(0.6402593, abs=1e-6)


def test_newer_jax_releases_use_plain_programs(monkeypatch):
    # There the attributes make programs slower, and abort the compiler on some loops.
    for version in [(0, 12, 0), (0, 13, 0), (1, 0, 0)]:
        monkeypatch.setattr(jax, "__version_info__", version)
        assert _jax._choose_outlined() is _jax._plain


@pytest.mark.skipif(not _jax.OUTLINES, reason="on this JAX programs are plain anyway")
@pytest.mark.parametrize("absent", ["jax.experimental.xla_metadata", "jax.interpreters.mlir"])
def test_absent_jax_interface_selects_plain_programs(monkeypatch, absent):
    for name in [name for name in sys.modules if name.startswith("dvax._jax.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, absent, None)
    parent, _, last = absent.rpartition(".")
    monkeypatch.delattr(sys.modules[parent], last)
    assert _jax._choose_outlined() is _jax._plain


@pytest.mark.parametrize("way", ["fixed", "vmap"])
def test_outline_attributes_are_set_if_and_only_if_OUTLINES(way):
    run = WAYS[way][0]
    text = jax.jit(run).lower(3.0).compile().as_text()
    outlined = 'inlineable="false",xla_cpu_small_call="true"' in text
    assert outlined == (_jax.OUTLINES and jax.default_backend() == "cpu")


def test_solve_works_without_unstable_jax_interfaces():
    program = """
import sys
for name in ("outlined", "forward_only"):
    sys.modules["dvax._jax." + name] = None
import jax
del jax.monitoring.register_event_duration_secs_listener
import dvax
import dvax._jax
assert not dvax._jax.OUTLINES
problem = dvax.Problem(
    A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    f=lambda t, x, u, args: 3.0 - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
)
sol = dvax.solve(problem, -1.0, 0.0, 2.0)
forward = jax.jvp(lambda x: dvax.solve(problem, x, 0.0, 2.0, adjoint="forward").xs[-1], (-1.0,), (1.0,))
print(f"{float(sol.xs[-1]):.5f} {float(forward[0]):.5f}", sol.stats["compile_time"] > 0)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    # What is traced is timed all the same.
    assert done.stdout == "1.83609 1.83609 True\n", done.stderr


@pytest.mark.slow
def test_an_array_as_state_with_a_tuple_as_response_is_solved():
    # u = (clip(x), clip(x)): x' = −x + 1 − 2 min(x, 1) from 0, so that x = (1 − e^{−3t})/3.
    Euclidean, Box, same = dvax.spaces.Euclidean, dvax.sets.Box, dvax.operators.Scaling(1.0)
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Product(same, same),
        K=dvax.sets.Product(Box(-1.0, 1.0), Box(0.0, 2.0)),
        f=lambda t, x, u, args: 1.0 - u[0] - u[1],
        h=lambda t, x, u, args: (x, x),
        control_space=dvax.spaces.Product(Euclidean(()), Euclidean(())),
    )
    solution = dvax.solve(problem, 0.0, 0.0, 1.0)
    assert solution.xs[-1] == pytest.approx(-np.expm1(-3.0) / 3.0, rel=1e-5)
