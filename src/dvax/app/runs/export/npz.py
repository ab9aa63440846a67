"""NPZ: one array for each variable, and the text `metadata`, JSON with their units and the history.

Arrays are written block by block: no array needs to fit into memory. Nothing is pickled.
"""

import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dvax.app.plots.store import Variable
from dvax.app.runs.export.selection import Selection, blocks

SUFFIX = ".npz"
_METADATA = "metadata"


def parts(selection: Selection) -> dict[str, Any]:
    """Return the function that writes the file, under the name "trajectory"."""
    return {"trajectory": lambda path: _write(selection, path)}


def notes(selection: Selection) -> list[str]:
    return []


def _write(selection: Selection, path: Path) -> None:
    variables = {
        name: {**selection.attributes(name), "dims": list(v.dims)}
        for name, v in selection.variables.items()
    }
    text = json.dumps(
        {"attributes": dict(selection.attrs), "variables": variables}, ensure_ascii=False,
        default=lambda value: value.tolist(),
    )  # fmt: skip
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, variable in selection.variables.items():
            _add(archive, name, variable.dtype, variable.shape, _blocks(variable))
        metadata = np.asarray(text)
        _add(archive, _METADATA, metadata.dtype, (), [metadata])


def _blocks(variable: Variable) -> Iterator[np.ndarray]:
    if not variable.dims:
        yield variable.values
        return
    for block in blocks([variable], variable.shape[0]):
        yield variable.frames(block)


def _add(archive: zipfile.ZipFile, name: str, dtype: np.dtype, shape: Any, rows: Any) -> None:
    """Append an array in NumPy's format, from blocks of its rows in C order."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        description = np.lib.format.dtype_to_descr(dtype)
        header = {"descr": description, "fortran_order": False, "shape": tuple(shape)}
        np.lib.format.write_array_header_2_0(file, header)
        for block in rows:
            file.write(np.ascontiguousarray(block, dtype).tobytes())
