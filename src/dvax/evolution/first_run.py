"""What is examined once for a problem: its data before the first run, and its states after it."""

import math
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import SolveError, input_error
from ..problem import Problem
from .nonfinite import first_bad, nonfinite_data
from .several_solutions import warn_of_several_solutions
from .signature import flat

_SEEN: set[Any] = set()
"""The problems that were examined, by their code and the shapes of their arrays."""

_MAX_SEEN = 256

_MAX_ROWS = 64
"""Most saved states that are looked at."""

_SHARE = 0.1
"""Largest share of the state that atol may be without a warning."""

_ROUNDINGS = 100.0
"""Multiple of a rounding of u in f at each time, up to which a state counts as rounding."""


def key_of_first_run(problem: Problem, t0: Any, x0: Tree, args: Any) -> Any:
    """Return a key of the code of the problem and the shapes of its data, None where it is traced, or
    was examined before."""
    leaves, tree = jtu.tree_flatten((x0, args))
    numbers = [leaf if isinstance(leaf, float) else np.shape(leaf) for leaf in leaves]
    key = flat(problem).key, tree, tuple(type(n) if isinstance(n, float) else n for n in numbers)
    is_new = key not in _SEEN and _tree.is_concrete(flat(problem).numbers, t0, leaves)
    return key if is_new else None


def check_before_first_run(problem: Problem, t0: Any, t1: Any, x0: Tree, args: Any) -> None:
    """Refuse data that end too early, or that are NaN where they are used, before the compilation of
    a run that would fail.

    **Raises:** `dvax.InputError`.
    """
    args = _tree.as_arrays(args)
    if _tree.is_concrete(t1):
        problem.check_spans(t0, t1, x0, args)
        _check_not_saved_times(problem, t0, t1, x0, args)
    wrong = nonfinite_data(problem, args, "dvax.solve")
    if wrong:
        t, u = jnp.asarray(t0, _tree.dtype(x0)), problem.zero_control(x0)
        used = (problem.f(t, x0, u, args), problem.h(t, x0, u, args), problem.set_at(t, args))
        if first_bad((problem.A, problem.P, used), allow_infinite=True):
            wrong.raise_any()


def _check_not_saved_times(problem: Problem, t0: Any, t1: Any, x0: Tree, args: Any) -> None:
    """Refuse times of [t0, t1] as args that no function uses: they were meant to be saved times."""
    if not isinstance(args, np.ndarray | jax.Array) or np.ndim(args) != 1 or np.size(args) < 2:
        return
    times = np.asarray(args)
    if times[0] < float(t0) or times[-1] > float(t1) or not np.all(np.diff(times) > 0):
        return
    t, u = jnp.asarray(t0, _tree.dtype(x0)), problem.zero_control(x0)

    def values(args: Any) -> list[Any]:
        parts = problem.f(t, x0, u, args), problem.h(t, x0, u, args), problem.set_at(t, args)
        found = jtu.tree_leaves((parts, problem.generator(args), problem.operator(args)))
        return [leaf for leaf in found if eqx.is_array(leaf)]

    program = jax.make_jaxpr(values)(args).jaxpr
    used = [*program.outvars, *(v for e in program.eqns for v in e.invars)]
    if program.invars[0] not in used:
        raise input_error(
            "dvax.solve(args)", f"{times.size} times from {times[0]:g} to {times[-1]:g}",
            "the argument after t1 is args, and no function of the problem uses it",
            "Pass saved times by name, dvax.solve(problem, x0, t0, t1, ts=...), or leave args out",
        )  # fmt: skip


def warn_after_first_run(
    key: Any,
    problem: Problem,
    t0: Any,
    x0: Tree,
    args: Any,
    moduli: Any,
    saved: tuple[Any, Tree] | None = None,
    atol: Any = None,
) -> None:
    """Warn of a law with several solutions and of states that atol hides, and store the `key`
    (`key_of_first_run`).

    `saved`: times and states of a run with the tolerance `atol`; without them, of the law alone.
    """
    if len(_SEEN) >= _MAX_SEEN:
        _SEEN.clear()
    _SEEN.add(key)
    warn_of_several_solutions(problem, t0, x0, args, moduli)
    if saved is not None and _tree.is_concrete(saved, atol):
        _warn_of_small_states(problem, t0, x0, args, *saved, float(atol))


def _warn_of_small_states(
    problem: Problem, t0: Any, x0: Tree, args: Any, ts: Any, xs: Tree, atol: float
) -> None:
    """Warn if atol is more than a tenth of the largest state, unless all of them are 0 or rounding."""
    weights, row = problem.spaces(x0)[0].weights(), lambda k: jtu.tree_map(lambda leaf: leaf[k], xs)
    rows = np.unique(np.linspace(0, len(ts) - 1, _MAX_ROWS).astype(int)) if len(ts) else []
    largest = max(_norm(weights, x) for x in (x0, *map(row, rows)))
    if not 0.0 < largest < atol / _SHARE:
        return
    if len(ts) and _is_zero(problem, args, x0, [ts[k] for k in rows]):
        return
    warnings.warn(
        f"atol = {atol:g} hides the solution: the norm of x is at most {largest:.3g} at t0 and at "
        "the saved times, so an error as large as x itself may pass. Pass "
        f"atol = {1e-3 * largest:.0e} or less, or choose units in which x is of size 1.",
        stacklevel=4,
    )


def _is_zero(problem: Problem, args: Any, x0: Tree, ts: Any) -> bool:
    """Return whether x = 0 is the solution up to rounding: x0 = 0, and at each time of `ts` the terms
    of f̃(t, 0) cancel. A method may amplify these rounding errors up to the tolerance."""
    x = jtu.tree_map(jnp.zeros_like, x0)
    weights = problem.spaces(x)[0].weights()
    if _norm(weights, x0) > 0.0:
        return False

    @jax.jit
    def rate(t: Any, u: Tree) -> Any:
        """Return f(t, 0, u) and the part of it that u causes."""
        return jax.jvp(lambda u: problem.f(t, x, u, args), (u,), (u,))

    roundings = _ROUNDINGS * float(jnp.finfo(_tree.dtype(x)).eps)
    try:
        for t in ts:
            value, caused = rate(t, problem.response(t, x, args))
            if not _norm(weights, value) <= roundings * _norm(weights, caused):
                return False
    except SolveError:
        return False
    return True


def _norm(weights: Tree, x: Tree) -> float:
    """Return ‖x‖, with NumPy: each operation of JAX would compile a program."""
    squares = jtu.tree_map(lambda w, leaf: np.sum(np.asarray(w) * np.square(leaf)), weights, x)
    return math.sqrt(sum(map(float, jtu.tree_leaves(squares))))
