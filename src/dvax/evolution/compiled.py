"""The compiled time loop, cached for calls with the same code and the same shapes.

The overhead of a call is the lookup of the compiled program. `jax.jit` needs microseconds for a flat
list of numbers and one hashable static argument. This module therefore flattens a setup into these two,
and rebuilds the solution around the original setup, which is not copied.
"""

import math
import threading
import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._jax.compile_clock import listen
from .._jax.messages import is_equinox_check
from ..errors import InputError, InputProblem
from .integrate import integrate
from .results import has_failed
from .setup import Options, Setup
from .solution import Solution


def compiled(setup: Setup, ts: Any, options: Options) -> tuple[Solution, bool | jax.Array]:
    """Return the solution, and whether the run succeeded and reached all saved times."""
    code, code_tree = jtu.tree_flatten((setup.problem, setup.method, setup.vi_solver, setup.events))
    data, data_tree = jtu.tree_flatten((setup.x0, setup.args, setup.setting, setup.moduli, ts))
    # Python floats in the data are traced, so that a new tolerance does not recompile. In the code
    # (settings of a solver) they are static, since they may decide a branch.
    numbers = [leaf if eqx.is_array(leaf) else None for leaf in code]
    numbers += [leaf if isinstance(leaf, float) or eqx.is_array(leaf) else None for leaf in data]
    static = tuple(
        _exact_key(leaf) if number is None else None
        for leaf, number in zip(code + data, numbers, strict=True)
    )
    start, _clock.compiling = time.perf_counter(), 0.0
    try:
        arrays, reached, shape = _run(numbers, _Signature(code_tree, data_tree, static, options))
        # Convert by NumPy: by JAX this would compile and run another program.
        reached = bool(np.asarray(reached)) if _tree.is_concrete(reached) else reached
    except jax.errors.JaxRuntimeError as error:
        if is_equinox_check(error):
            # Run again under Equinox, which reports the message of an `eqx.error_if` in f or h.
            eqx.filter_jit(integrate)(setup, ts, options)
        raise
    solution = jtu.tree_unflatten(shape.value, [*arrays, setup])
    if isinstance(reached, bool):
        compiling = _clock.compiling
        spent = time.perf_counter() - start
        solution.stats.update(compile_time=compiling, run_time=spent - compiling)
    return solution, reached


def _exact_key(leaf: Any) -> tuple[Any, ...]:
    """Return a hashable key of a static leaf that distinguishes 1, True and 1.0, and 0.0 and −0.0."""
    try:
        hash(leaf)
    except TypeError as error:
        raise InputError(
            InputProblem(
                "dvax.solve(problem, args)",
                f"{type(leaf).__name__} {_tree.line(leaf)}",
                "values that are not arrays are static arguments, which must be hashable",
                "Register its class as a pytree (such as an equinox.Module), or make it hashable",
            )
        ) from error
    return type(leaf), leaf, math.copysign(1.0, leaf) if isinstance(leaf, float) else None


class _Signature(NamedTuple):
    """The static argument: the tree structures of code and data, the static leaves, and the options."""

    code: Any
    data: Any
    static: tuple[Any, ...]
    options: Options


class _Clock(threading.local):
    """Seconds that this thread has spent on tracing and compiling the program of its call."""

    compiling: float = 0.0


_clock = _Clock()


def _add(stage: str, seconds: float) -> None:
    # `_traced` measures the time of tracing.
    if stage != "trace":
        _clock.compiling += seconds


listen(_add)


def _traced(numbers: list[Any], signature: _Signature) -> tuple[list[Any], jax.Array, _tree.Static]:
    start = time.perf_counter()
    outputs = _integrated(numbers, signature)
    # Assign instead of adding: this time includes programs compiled while tracing.
    _clock.compiling = time.perf_counter() - start
    return outputs


def _integrated(
    numbers: list[Any], signature: _Signature
) -> tuple[list[Any], jax.Array, _tree.Static]:
    leaves = [r[1] if n is None else n for n, r in zip(numbers, signature.static, strict=True)]
    split = signature.code.num_leaves
    problem, method, vi_solver, events = jtu.tree_unflatten(signature.code, leaves[:split])
    x0, args, setting, moduli, ts = jtu.tree_unflatten(signature.data, leaves[split:])
    setup = Setup(problem, x0, args, setting, method, vi_solver, moduli, events)
    solution = integrate(setup, ts, signature.options)
    reached = ~has_failed(solution.result, solution.ts)
    arrays, tree = jtu.tree_flatten(solution, is_leaf=lambda node: node is setup)
    assert arrays.pop() is setup
    # `tree` is the structure of a solution whose last leaf is the setup.
    return arrays, reached, _tree.Static(tree)


_run = jax.jit(_traced, static_argnums=1)
