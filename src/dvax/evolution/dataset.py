"""Solutions and their events as `xarray.Dataset`."""

from typing import Any

import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._dataset import Names, Variable, dataset, described, named, over
from .._tree import Tree
from ..errors import input_error
from .results import RESULTS

_PLACE = "Solution.to_xarray"


def solution_dataset(
    sol: Any, states: Names, responses: Names, time_unit: str, bound: Any = None
) -> Any:
    """Return the dataset of a `Solution` or `ExportedSolution` (see `Solution.to_xarray`)."""
    check_single(sol, _PLACE)
    variables: dict[str, Variable] = {}
    every = (
        ("x", "state", sol.xs, states, "states"),
        ("u", "response", sol.us, responses, "responses"),
        ("y", "y = P u,", sol.ys, None, "responses"),
    )
    for symbol, words, rows, names, argument in every:
        found = named(rows, names, symbol, f"{_PLACE}({argument})")
        taken = sorted({"time", *variables} & set(found))
        if taken:
            raise input_error(
                f"{_PLACE}({argument})", ", ".join(taken), "this name stands for another variable",
                "Choose others",
            )  # fmt: skip
        for name, (values, unit) in found.items():
            variables[name] = over(("time",), name, values, described(f"{words} {name}", unit))
    for name, words, series in (
        ("law_error", "certified bound on ‖u − u*‖ of the law", sol.law_error),
        ("defect", "integral of the norm of the defect", sol.defect),
    ):
        if series is not None:
            variables[name] = ("time",), series, described(words)
    if bound is not None:
        check_bound(sol, bound, f"{_PLACE}(bound)")
        for letter, series in (("x", bound.x), ("u", bound.u)):
            about = described(f"bound on ‖{letter}_h − {letter}‖", status=bound.status)
            variables[f"error_bound_{letter}"] = ("time",), series, about
    time = ("time",), sol.ts, described("time", time_unit or None)
    stats = {n: sol.stats[n] for n in ("method", "steps", "rejected") if n in sol.stats}
    attrs = {n: str(v) if isinstance(v, str) else int(v) for n, v in stats.items()}
    return dataset(_PLACE, variables, {"time": time}, {**attrs, "result": RESULTS[sol.result]})


def events_dataset(ts: Any, index: Any, names: Any, xs: Tree, xs_after: Tree) -> Any:
    """Return the dataset of `Events`, without empty rows."""
    place = "Events.to_xarray"
    if not _tree.is_concrete(index):
        dataset(place, {"index": (("event",), index, {})})  # raises
    kept = np.asarray(index) >= 0
    positions = np.asarray(index)[kept]
    texts = np.asarray([names[k] or "" for k in positions], dtype=str)
    variables: dict[str, Variable] = {
        "index": (("event",), positions, described("position in events=[…]", "")),
        "name": (("event",), texts, described("name of the event")),
    }
    for symbol, words, rows in (
        ("x", "state in which the event happened,", xs),
        ("x_after", "state behind its reset,", xs_after),
    ):
        for name, (values, _) in named(rows, None, symbol, place).items():
            values = np.asarray(values)[kept]
            variables[name] = over(("event",), name, values, described(f"{words} {name}"))
    return dataset(
        place, variables, {"time": (("event",), np.asarray(ts)[kept], described("time"))}
    )


def check_single(sol: Any, place: str) -> None:
    """Raise an `InputError` unless `sol` has values, and is one solution and no batch of them."""
    if not _tree.is_concrete(sol.ts, sol.xs):
        given, fix = (
            "a solution inside a compiled program",
            "Call it outside of jax.jit and jax.vmap",
        )
    elif np.ndim(sol.ts) != 1:
        given, fix = "a batch of solutions", "Select one: jax.tree.map(lambda leaf: leaf[0], sol)"
    else:
        return
    raise input_error(place, given, "it needs the numbers of one solution", fix)


def check_bound(sol: Any, bound: Any, place: str) -> None:
    """Raise an `InputError` unless `bound` is one at the saved times of `sol`."""
    ts = getattr(bound, "ts", None)
    if ts is None or not np.array_equal(np.asarray(ts), np.asarray(sol.ts)):
        given = type(bound).__name__ if ts is None else f"a bound at {np.size(ts)} other times"
        raise input_error(
            place, given, f"it must be a bound at the {np.size(sol.ts)} saved times",
            "Pass dvax.bound_error(problem, sol, constants) of this solution",
        )  # fmt: skip


def leaves_of(tree: Tree, name: str) -> dict[str, Any]:
    """Return the leaves of a tree by their names: `name` alone, `name`0, …, or the keys of a dict."""
    found = jtu.tree_leaves_with_path(tree)
    if len(found) == 1 and not found[0][0]:
        return {name: found[0][1]}
    return {_label(path, name): leaf for path, leaf in found}


def _label(path: Any, name: str) -> str:
    keys = [str(getattr(k, "key", getattr(k, "name", getattr(k, "idx", k)))) for k in path]
    return "_".join([f"{name}{keys[0]}" if keys[0].isdigit() else keys[0], *keys[1:]])
