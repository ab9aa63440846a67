"""Results as `xarray.Dataset`, with names, units and attributes by the CF conventions.

A variable is (dimensions, values, attributes), as xarray takes it; xarray itself is imported when a
dataset is made.
"""

import importlib
import math
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import jax.tree_util as jtu
import numpy as np

from . import _tree
from ._tree import Tree
from .errors import input_error

Variable = tuple[tuple[str, ...], Any, dict[str, Any]]
Names = Mapping[str, str] | Sequence[str] | None
"""Names for the entries of a state or response, or for its parts, with their units where known."""


def required(module: str, place: str) -> Any:
    """Import a module of the extra `dvax[app]` for a function.

    **Raises:** `ModuleNotFoundError` with the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{place} needs the package {error.name}, which is not installed: "
            "pip install 'dvax[app]'",
            name=error.name,
        ) from error


def dataset(
    place: str,
    variables: Mapping[str, Variable],
    coords: Mapping[str, Variable] | None = None,
    attrs: Mapping[str, Any] | None = None,
) -> Any:
    """Return the dataset of these variables.

    **Raises:** `dvax.InputError` if a value is traced; `ModuleNotFoundError` without xarray.
    """
    xarray = required("xarray", place)
    every = {**variables, **(coords or {})}
    if not _tree.is_concrete([values for _, values, _ in every.values()]):
        raise input_error(
            place, "a result inside a compiled program", "a dataset holds numbers",
            "Call it outside of jax.jit, jax.vmap and jax.grad",
        )  # fmt: skip
    about = {"Conventions": "CF-1.11", "source": f"dvax {version('dvax')}", **(attrs or {})}
    return xarray.Dataset(*(_as_numpy(v) for v in (variables, coords or {})), attrs=about)


def _as_numpy(variables: Mapping[str, Variable]) -> dict[str, Variable]:
    return {n: (dims, np.asarray(v), attrs) for n, (dims, v, attrs) in variables.items()}


def described(words: str, unit: str | None = None, **more: Any) -> dict[str, Any]:
    """Return attributes: `long_name`, and `units` unless the unit is not known (None); "1" for a number
    without one."""
    return {"long_name": words, **({} if unit is None else {"units": unit or "1"}), **more}


def over(dims: tuple[str, ...], name: str, rows: Any, attrs: dict[str, Any]) -> Variable:
    """Return a variable whose first axes are `dims`; the others are `name_dim0`, `name_dim1`, …"""
    extra = tuple(f"{name}_dim{k}" for k in range(np.ndim(rows) - len(dims)))
    return (*dims, *extra), rows, attrs


def named(rows: Tree, names: Names, symbol: str, place: str) -> dict[str, tuple[Any, str | None]]:
    """Return values and unit of each part of `rows`, a time axis in front; with `names`, of each entry
    or part that they name. Without names a tuple has the parts `symbol`0, `symbol`1, …, and no units.

    **Raises:** `dvax.InputError` if there are neither as many names as entries nor as parts.
    """
    leaves = jtu.tree_leaves(rows)
    if not names:
        of = [symbol] if len(leaves) == 1 else [f"{symbol}{k}" for k in range(len(leaves))]
        return {name: (leaf, None) for name, leaf in zip(of, leaves, strict=True)}
    if isinstance(names, str) or not isinstance(names, Mapping | Sequence):
        raise input_error(
            place, _tree.line(names), "it is a dictionary of names and units, or a list of names",
            'Write {"position": "m"}, say',
        )  # fmt: skip
    units = dict(names) if isinstance(names, Mapping) else dict.fromkeys(map(str, names))
    entries = sum(math.prod(leaf.shape[1:]) for leaf in leaves)
    if len(units) not in (len(leaves), entries) or len(units) < len(names):
        parts = f", or for each of the {len(leaves)} parts" if len(leaves) != entries else ""
        raise input_error(
            place, ", ".join(map(str, names)),
            f"it needs a name of its own for each of the {entries} entries{parts}",
            "Add or remove names",
        )  # fmt: skip
    if len(units) == entries:
        flat = np.concatenate([np.asarray(v).reshape(len(v), -1) for v in leaves], axis=1)
        return {n: (flat[:, k], unit) for k, (n, unit) in enumerate(units.items())}
    return {n: (leaf, unit) for leaf, (n, unit) in zip(leaves, units.items(), strict=True)}
