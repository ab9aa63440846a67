"""`dvax.export`: a solve as a serialised program."""

from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import equinox as eqx
import jax
import jax.export
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem, Problems, input_error
from ..problem import Problem
from .arguments import bound_steps
from .exported import (
    FORMAT,
    Exported,
    Header,
    Input,
    require_serialisation,
    split_args,
    structure,
)
from .implicit import Implicit
from .piecewise.method import PiecewiseLinear
from .results import RESULTS, result_names
from .solution import Solution
from .solve import solve

_OPTIONS = (
    "dt", "rtol", "atol", "method", "vi_solver", "constants", "measure", "dt0", "dt_max", "max_steps",
    "events", "max_events",
)  # fmt: skip
"""The options of `dvax.solve` that are compiled into the program."""


def export(
    problem: Problem,
    x0: Tree,
    t0: Any,
    t1: Any,
    args: Any = None,
    ts: Any = None,
    *,
    derivatives: int = 0,
    platforms: Sequence[str] | None = None,
    **options: Any,
) -> Exported:
    """Return `dvax.solve(problem, x0, t0, t1, args, ts, …)` as a program that can be saved.

    The program takes x0, t0, t1, the numbers and arrays in `args`, and `ts`, with the shapes and types
    of this example. Everything else is compiled in: the functions, arrays in closures, integers and
    flags in `args`, and the options. It needs neither the functions nor the packages that they use.

    **Arguments:** as in `dvax.solve`, which solves the example first: the program has the method that
    this solve ended with. `derivatives`: how many times `jax.grad` may be applied to the program;
    `platforms`: those that it runs on, of "cpu", "cuda", "rocm" and "tpu", by default that of this
    process. With fixed steps `max_steps` follows from the example; pass it for longer runs.

    **Returns:** a `dvax.evolution.Exported`: call it, or write it to a file with its `save`, for
    `dvax.load_exported`.

    **Raises:** the errors of `dvax.solve` on the example; `dvax.InputError` for options that a program
    cannot have, such as `dense` and `progress`, for the methods `Implicit` and `PiecewiseLinear`, which
    call Python during a run, and if the code uses operations that JAX does not serialise, such as
    callbacks to Python (`jax.debug.print`, `equinox.error_if`).

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: args["load"] - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> run = dvax.export(problem, -1.0, 0.0, 2.0, {"load": 3.0})
    >>> run.save("run.dvax")                                       # doctest: +SKIP
    >>> run = dvax.load_exported("run.dvax")                       # doctest: +SKIP
    >>> print(f"{float(run(-1.0).xs[0]):.4f} {float(run(-1.0, args={'load': 2.0}).xs[0]):.4f}")
    1.8361 1.1899

    ```
    """
    _check(options, derivatives)
    require_serialisation()
    example = solve(problem, x0, t0, t1, args, ts, **options)
    setup = example.setup
    if isinstance(setup.method, Implicit | PiecewiseLinear):
        raise input_error(
            "dvax.export(method)", type(setup.method).__name__,
            "it calls Python during a run, which no serialised program can",
            "Pass method=dvax.ExpRosenbrock() for a stiff problem, or leave it out",
        )  # fmt: skip
    if options.get("dt") is not None and options.get("max_steps") is None:
        options["max_steps"] = bound_steps(None, True, t0, t1, options["dt"])
    options |= {"method": setup.method, "throw": False}
    numbers, static = split_args(args)
    x_leaves, x_tree = jtu.tree_flatten(setup.x0)
    dtype = _tree.dtype(setup.x0)
    states = [("x0" if x_tree.num_leaves == 1 else f"x0[{k}]", v) for k, v in enumerate(x_leaves)]
    times = [
        (n, np.asarray(v, dtype)) for n, v in (("t0", t0), ("t1", t1), ("ts", ts)) if v is not None
    ]
    # A Python number has the type of the state.
    numbers = [(n, np.asarray(v, dtype) if isinstance(v, float) else v) for n, v in numbers]
    given = [*states, *times, *numbers]
    leaves, tree = jtu.tree_flatten(_tree.as_arrays(args))
    is_number = [isinstance(leaf, jax.Array | np.ndarray) for leaf in leaves]

    def program(inputs: list[Any]) -> dict[str, Any]:
        x, rest = inputs[: len(states)], inputs[len(states) :]
        (t0, t1, *ts), own = rest[: len(times)], iter(rest[len(times) :])
        whole = [next(own) if n else leaf for leaf, n in zip(leaves, is_number, strict=True)]
        times_to_save = ts[0] if ts else None
        return _outputs(
            solve(
                problem,
                x_tree.unflatten(x),
                t0,
                t1,
                tree.unflatten(whole),
                times_to_save,
                **options,
            )
        )

    specs = [jax.ShapeDtypeStruct(jnp.shape(v), jnp.result_type(v)) for _, v in given]
    exported, contents = _serialise(program, specs, platforms, derivatives)
    header = Header(
        FORMAT, version("dvax"), jax.__version__, exported.calling_convention_version,
        list(exported.platforms), example.stats["method"], derivatives, structure(setup.x0),
        structure(problem.zero_control(setup.x0)),
        [Input.of(name, v) for name, v in given], static, ts is not None, result_names(),
        None if example.events is None else list(example.events.names),
    )  # fmt: skip
    return Exported(header, contents, [np.asarray(v) for _, v in given])


def _check(options: dict[str, Any], derivatives: Any) -> None:
    wrong = Problems(
        InputProblem(
            f"dvax.export({name})", _tree.line(value),
            f"a program has the options {', '.join(_OPTIONS)}", "Leave it out",
        )
        for name, value in options.items()
        if name not in _OPTIONS
    )  # fmt: skip
    if not (
        isinstance(derivatives, int) and not isinstance(derivatives, bool) and derivatives >= 0
    ):
        wrong.add(
            "dvax.export(derivatives)", _tree.line(derivatives), "it must be a whole number ≥ 0",
            "Write derivatives=1 for jax.grad",
        )  # fmt: skip
    wrong.raise_any()


def _outputs(sol: Solution) -> dict[str, Any]:
    """Return a solution as lists and dictionaries, which `jax.export` can serialise."""
    found = sol.responses()
    results = (getattr(RESULTS, name) for name in result_names())
    code = sum(jnp.where(sol.result == result, k, 0) for k, result in enumerate(results))
    stats = {name: v for name, v in sol.stats.items() if eqx.is_array(v)}
    events = None
    if sol.events is not None:
        xs, after = map(jtu.tree_leaves, (sol.events.xs, sol.events.xs_after))
        events = {"ts": sol.events.ts, "index": sol.events.index, "xs": xs, "xs_after": after}
    return {
        "ts": sol.ts, "xs": jtu.tree_leaves(sol.xs), "us": jtu.tree_leaves(found.us),
        "ys": jtu.tree_leaves(found.ys), "law_residual": found.law_residual, "law_step": found.law_step,
        "law_error": found.law_error, "defect": sol.defect, "code": code,
        "stats": stats | {"x": jtu.tree_leaves(sol.stats["x"])}, "events": events,
    }  # fmt: skip


def _serialise(
    program: Any, specs: list[Any], platforms: Any, derivatives: int
) -> tuple[jax.export.Exported, bytes]:
    try:
        exported = jax.export.export(jax.jit(program), platforms=platforms)(specs)
        return exported, bytes(exported.serialize(vjp_order=derivatives))
    except (ValueError, NotImplementedError) as error:
        if isinstance(error, InputError):
            raise
        raise input_error(
            "dvax.export(problem)", "code that JAX does not serialise",
            f"jax.export reports: {_tree.line(error, 300)}",
            "Remove callbacks to Python (jax.debug.print, equinox.error_if) from the functions, "
            "and check platforms=",
        ) from error  # fmt: skip
