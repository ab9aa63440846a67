"""One compiled time loop for all calls of one kind: the same code on the same shapes.

What a call costs besides its steps is to find out that it is of that kind. `jax.jit` finds out in
microseconds where it is handed a flat list of numbers and one hashable rest; so a setup is taken
apart here, and its solution put together, around the setup itself: what was asked is not copied.
"""

import math
import threading
import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._jax.compile_clock import listen
from .._jax.messages import is_equinox_check
from ..errors import InputError, InputProblem
from .integrate import integrate
from .results import RESULTS
from .setup import Options, Setup
from .solution import Solution


def compiled(setup: Setup, ts: Any, options: Options) -> tuple[Solution, bool | jax.Array]:
    """The solution, and whether all of it was reached."""
    code, code_tree = jtu.tree_flatten((setup.problem, setup.method, setup.vi_solver))
    data, data_tree = jtu.tree_flatten((setup.x0, setup.args, setup.setting, setup.moduli, ts))
    # A Python number in the data is data: compiled in, every new tolerance would compile again. In
    # the code (a setting of a solver) it may decide what is done.
    numbers = [leaf if eqx.is_array(leaf) else None for leaf in code]
    numbers += [leaf if isinstance(leaf, float) or eqx.is_array(leaf) else None for leaf in data]
    rest = tuple(
        _exactly(leaf) if number is None else None
        for leaf, number in zip(code + data, numbers, strict=True)
    )
    begun, _clock.compiling = time.perf_counter(), 0.0
    try:
        arrays, reached, shape = _run(numbers, _Kind(code_tree, data_tree, rest, options))
        # One look, through NumPy: through JAX it would be a program of its own.
        reached = bool(np.asarray(reached)) if _tree.is_concrete(reached) else reached
    except jax.errors.JaxRuntimeError as error:
        if is_equinox_check(error):
            # A check within f or h (`eqx.error_if`) is only quoted where Equinox compiles.
            eqx.filter_jit(integrate)(setup, ts, options)
        raise
    solution = jtu.tree_unflatten(shape.value, [*arrays, setup])
    if isinstance(reached, bool):
        compiling = _clock.compiling
        spent = time.perf_counter() - begun
        solution.stats.update(compile_time=compiling, run_time=spent - compiling)
    return solution, reached


def _exactly(leaf: Any) -> tuple[Any, ...]:
    """A leaf as a key that tells 1 from True and 1.0, and 0.0 from −0.0, which `==` does not."""
    try:
        hash(leaf)
    except TypeError as error:
        raise InputError(
            InputProblem(
                "dvax.solve(problem, args)",
                f"{type(leaf).__name__} {_tree.line(leaf)}",
                "what is not an array is compiled in, so it must be hashable",
                "Register its class as a pytree (an equinox.Module is one), or make it hashable",
            )
        ) from error
    return type(leaf), leaf, math.copysign(1.0, leaf) if isinstance(leaf, float) else None


class _Kind(NamedTuple):
    """All of a call but its numbers."""

    code: Any
    data: Any
    rest: tuple[Any, ...]
    options: Options


class _Clock(threading.local):
    """Seconds that this thread has spent on the program of its call until it ran."""

    compiling: float = 0.0


_clock = _Clock()


def _add(stage: str, seconds: float) -> None:
    # The seconds of tracing are measured by `_traced`.
    if stage != "trace":
        _clock.compiling += seconds


listen(_add)


def _traced(numbers: list[Any], kind: _Kind) -> tuple[list[Any], jax.Array, _tree.Static]:
    begun = time.perf_counter()
    found = _integrated(numbers, kind)
    # Programs that were compiled meanwhile are in this already.
    _clock.compiling = time.perf_counter() - begun
    return found


def _integrated(numbers: list[Any], kind: _Kind) -> tuple[list[Any], jax.Array, _tree.Static]:
    leaves = [r[1] if n is None else n for n, r in zip(numbers, kind.rest, strict=True)]
    split = kind.code.num_leaves
    problem, method, vi_solver = jtu.tree_unflatten(kind.code, leaves[:split])
    x0, args, setting, moduli, ts = jtu.tree_unflatten(kind.data, leaves[split:])
    setup = Setup(problem, x0, args, setting, method, vi_solver, moduli)
    solution = integrate(setup, ts, kind.options)
    reached = (solution.result == RESULTS.successful) & jnp.all(jnp.isfinite(solution.ts))
    arrays, tree = jtu.tree_flatten(solution, is_leaf=lambda node: node is setup)
    assert arrays.pop() is setup
    # The structure of a solution that has the setup for its last leaf.
    return arrays, reached, _tree.Static(tree)


_run = jax.jit(_traced, static_argnums=1)
