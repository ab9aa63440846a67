"""The compiled time loop, cached for calls with the same code and the same shapes.

The overhead of a call is the lookup of the compiled program. This module therefore flattens a setup
(`signature.flatten`), and rebuilds the solution around the original setup, which is not copied.
"""

import threading
import time
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._jax.compile_clock import listen
from .._jax.messages import is_equinox_check
from .closures import closure_convert
from .integrate import integrate
from .results import has_failed
from .setup import Options, Setup, pack, unpack
from .signature import Signature, flatten
from .solution import Solution


def compiled(setup: Setup, ts: Any, options: Options) -> tuple[Solution, bool | jax.Array]:
    """Return the solution, and whether the run succeeded and reached all saved times."""
    numbers, signature = _flat(setup, ts, options)
    start, _clock.compiling = time.perf_counter(), 0.0
    try:
        arrays, reached, static = _run(numbers, pack(setup.setting), signature)
        # Convert by NumPy: by JAX this would compile and run another program.
        reached = bool(np.asarray(reached)) if _tree.is_concrete(reached) else reached
    except jax.errors.JaxRuntimeError as error:
        if is_equinox_check(error):
            # Run again under Equinox, which reports the message of an `eqx.error_if` in f or h.
            eqx.filter_jit(integrate)(setup, ts, options)
        raise
    tree, closes_over_traced = static.value
    if closes_over_traced:
        # So that the solution may leave the transformation in which these values are traced.
        t0, args = setup.number("t0"), _tree.as_arrays(setup.args)
        problem = closure_convert(setup.problem, t0, setup.x0, args)
        setup = setup._replace(problem=problem)
    solution = jtu.tree_unflatten(tree, [*arrays, setup])
    if isinstance(reached, bool):
        compiling = _clock.compiling
        spent = time.perf_counter() - start
        solution.stats.update(compile_time=compiling, run_time=spent - compiling)
    return solution, reached


def compiled_text(setup: Setup, ts: Any, options: Options) -> str:
    """Return the program that `compiled` runs, as the text of its HLO."""
    numbers, signature = _flat(setup, ts, options)
    text = _run.lower(numbers, pack(setup.setting), signature).compile().as_text()
    assert text is not None
    return text


def _flat(setup: Setup, ts: Any, options: Options) -> tuple[list[Any], Signature]:
    return flatten(
        (setup.problem, setup.method, setup.vi_solver, setup.events),
        (setup.x0, setup.args, setup.moduli, ts),
        (options, tuple(setup.setting)),
    )


class _Clock(threading.local):
    """Seconds that this thread has spent on tracing and compiling the program of its call."""

    compiling: float = 0.0


_clock = _Clock()


def _add(stage: str, seconds: float) -> None:
    # `_traced` measures the time of tracing.
    if stage != "trace":
        _clock.compiling += seconds


listen(_add)


def _traced(
    numbers: list[Any], entries: Any, signature: Signature
) -> tuple[list[Any], jax.Array, _tree.Static]:
    start = time.perf_counter()
    outputs = _integrated(numbers, entries, signature)
    # Assign instead of adding: this time includes programs compiled while tracing.
    _clock.compiling = time.perf_counter() - start
    return outputs


def _integrated(
    numbers: list[Any], entries: Any, signature: Signature
) -> tuple[list[Any], jax.Array, _tree.Static]:
    (problem, method, vi_solver, events), data = signature.unflatten(numbers)
    x0, args, moduli, ts = data
    options, names = signature.options
    setting = unpack(entries, names)
    setup = Setup(problem, x0, args, setting, method, vi_solver, moduli, events)
    solution, closes_over_traced = integrate(setup, ts, options)
    reached = ~has_failed(solution.result, solution.ts)
    arrays, tree = jtu.tree_flatten(solution, is_leaf=lambda node: node is setup)
    assert arrays.pop() is setup
    # `tree` is the structure of a solution whose last leaf is the setup.
    return arrays, reached, _tree.Static((tree, closes_over_traced))


_run = jax.jit(_traced, static_argnums=2)
