"""NetCDF 4 by the CF conventions, through xarray and h5netcdf.

The largest variable has to fit into memory: variables are appended in batches.
"""

import json
import math
from pathlib import Path
from typing import Any

from dvax.app.runs.export.selection import Selection

SUFFIX = ".nc"
_BATCH_BYTES = 2**26
"""The most bytes of a batch of several variables. Each batch opens the file again."""


def parts(selection: Selection) -> dict[str, Any]:
    """Return the function that writes the file, under the name "trajectory"."""
    return {"trajectory": lambda path: _write(selection, path)}


def notes(selection: Selection) -> list[str]:
    return []


def _write(selection: Selection, path: Path) -> None:
    import xarray

    coords = {name: _variable(selection, name) for name in selection.coordinates}
    attrs = {name: _attribute(value) for name, value in selection.attrs.items()}
    mode = "w"
    for names in _batches(selection):
        variables = {name: _variable(selection, name) for name in names}
        _append(xarray.Dataset(variables, coords, attrs), path, mode)
        mode = "a"


def _batches(selection: Selection) -> list[list[str]]:
    """Return the names of the variables that are written together."""
    batches: list[list[str]] = [[]]
    size = 0
    for name, variable in selection.data.items():
        own = variable.dtype.itemsize * math.prod(variable.shape)
        if batches[-1] and size + own > _BATCH_BYTES:
            batches.append([])
            size = 0
        batches[-1].append(name)
        size += own
    return batches


def _append(dataset: Any, path: Path, mode: Any) -> None:
    # By CF, coordinates have no missing values; nor has anything else here.
    encoding: dict[Any, Any] = {name: {"_FillValue": None} for name in dataset.variables}
    for name, variable in dataset.variables.items():
        if variable.ndim and variable.dtype.kind in "iuf":
            encoding[name] |= {"zlib": True, "complevel": 1, "shuffle": True}
    dataset.to_netcdf(path, mode=mode, engine="h5netcdf", encoding=encoding)


def _variable(selection: Selection, name: str) -> Any:
    import xarray

    variable = selection.variables[name]
    attrs = {key: _attribute(value) for key, value in selection.attributes(name).items()}
    return xarray.Variable(variable.dims, variable.values, attrs)


def _attribute(value: Any) -> Any:
    """Return a value that NetCDF can hold: nested ones become JSON, a flag a number."""
    if isinstance(value, bool):
        return int(value)
    nested = isinstance(value, dict) or (
        isinstance(value, list) and not all(isinstance(v, int | float) for v in value)
    )
    return json.dumps(value, ensure_ascii=False) if nested else value
