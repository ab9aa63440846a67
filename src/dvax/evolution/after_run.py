"""Functions of the problem, the plan and rows of a run, compiled once for the same code and shapes."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._captured import require_unchanged
from .._jax.messages import is_equinox_check
from .._jax.traces import evaluates
from .._tree import Tree
from .outcome import Record
from .plan import Plan
from .setup import Setup, pack, unpack
from .signature import Signature, flatten

_SETTING = "t0", "t1", "dt", "rtol", "atol", "horizon"
"""The entries of `Setup.setting` that the tolerance of the law, its plan and dense output depend on."""

_LARGEST_BLOCK = 256
"""Largest number of rows that one program treats."""

_LARGEST_SIZE = 2**22
"""Largest number of entries of the rows that one program treats, where there are several rows."""

Function = Callable[[Setup, Plan, Any], Any]
"""A function of the setup, the plan and arrays, in a module: its identity is a part of the key of the
program."""


def after_run(function: Function, setup: Setup, plan: Plan, data: Any, depth: int = 0) -> Any:
    """Return function(setup, plan, data), from a program that is kept.

    Concrete values are computed at once even inside a transformation of other values. `depth` is the
    number of axes of a batch in front of all arrays: those of a solution that left
    `equinox.filter_vmap` have them.
    """
    require_unchanged(setup.problem, "dvax.Solution")
    code = setup.problem, setup.method, setup.vi_solver, plan
    setting = pack({name: setup.setting[name] for name in _SETTING})
    numbers, signature = flatten(
        code, (setup.x0, setup.args, setup.moduli, data), (function, depth)
    )
    given = numbers, setting
    if not _tree.is_concrete(given):
        return _compiled(*given, signature)
    with evaluates():
        try:
            return _compiled(*given, signature)
        except jax.errors.JaxRuntimeError as error:
            if is_equinox_check(error):
                # Run again under Equinox, which reports the message of an `eqx.error_if` in f or h.
                eqx.filter_jit(_batched)(*given, signature)
            raise


def at_rows(function: Function, setup: Setup, plan: Plan, rows: Tree) -> Tree:
    """Return `after_run` of concrete rows (arrays with one leading axis) in blocks, as NumPy arrays.

    The number of rows in a block is a power of two, so that few programs serve all numbers of rows.
    """
    rows = jtu.tree_map(_on_host, rows)
    leaves = jtu.tree_leaves(rows)
    count = len(leaves[0])
    entries = sum(leaf.size for leaf in leaves) // count
    largest = min(_LARGEST_BLOCK, 2 ** (max(1, _LARGEST_SIZE // entries).bit_length() - 1))
    block = min(largest, 2 ** (count - 1).bit_length())
    parts = []
    for start in range(0, count, block):
        which = np.minimum(np.arange(start, start + block), count - 1)
        part = jtu.tree_map(lambda leaf, which=which: leaf[which], rows)
        parts.append(after_run(function, setup, plan, part))
    return jtu.tree_map(lambda *leaf: np.concatenate(list(map(np.asarray, leaf)))[:count], *parts)


def steps_at(records: Record, which: Any) -> Record:
    """Return the records of these steps (indices or a slice)."""
    return jtu.tree_map(lambda leaf: _on_host(leaf)[which], records)


def _on_host(leaf: Any) -> Any:
    """Return an array as one of NumPy where it is on the host: each operation of JAX on another number
    of rows is another program."""
    return np.asarray(leaf) if _tree.is_on_host(leaf) else leaf


def _batched(numbers: list[Any], setting: Any, signature: Signature) -> Any:
    """Return the value for a batch, whose axes are in front of all arrays.

    Python floats, which no transformation has seen, have none: nor has a setting of these alone.
    """
    function, depth = signature.options
    run = partial(_called, function=function, signature=signature)
    seen = numbers, setting if isinstance(setting, list) else None
    axes = jtu.tree_map(lambda leaf: 0 if jnp.ndim(leaf) >= depth else None, seen)
    for _ in range(depth):
        run = jax.vmap(run, in_axes=axes)
    return run(numbers, setting)


def _called(numbers: list[Any], entries: Any, function: Function, signature: Signature) -> Any:
    (problem, method, vi_solver, plan), (x0, args, moduli, data) = signature.unflatten(numbers)
    setting = unpack(entries, _SETTING)
    return function(Setup(problem, x0, args, setting, method, vi_solver, moduli), plan, data)


_compiled = jax.jit(_batched, static_argnums=2)
