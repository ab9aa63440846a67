"""Parquet: a table for each first dimension, written by blocks of rows.

A variable with further dimensions is a column of lists of fixed length. The metadata of a field hold
`units`, `long_name`, `dims` and `shape`, that of the lists; those of the schema the attributes of the
run.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from dvax.app.runs.export.selection import Selection
from dvax.app.runs.export.tables import Table, tables
from dvax.errors import input_error

SUFFIX = ".parquet"


def parts(selection: Selection) -> dict[str, Any]:
    """Return, by the name of each table, the function that writes it to a path.

    **Raises:** `dvax.InputError` if pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise input_error(
            "--format parquet", "no module 'pyarrow'", "Parquet files are written by pyarrow",
            "pip install 'dvax[parquet]'",
        ) from error  # fmt: skip
    return {t.dim or "numbers": _writer(selection, t) for t in tables(selection)}


def notes(selection: Selection) -> list[str]:
    return []


def _writer(selection: Selection, table: Table) -> Any:
    import pyarrow as pa
    from pyarrow import parquet

    def write(path: Path) -> None:
        schema = _schema(selection, table)
        with parquet.ParquetWriter(path, schema, use_dictionary=False) as writer:
            for block, values in table.blocks(selection):
                columns = {n: _column(v, selection.variables[n].shape) for n, v in values.items()}
                if table.has_index:
                    columns = {table.dim: pa.array(np.arange(block.start, block.stop)), **columns}
                writer.write_table(pa.table(columns, schema=schema))

    return write


def _schema(selection: Selection, table: Table) -> Any:
    import pyarrow as pa

    fields = [pa.field(table.dim, pa.int64())] if table.has_index else []
    for name in table.names:
        variable = selection.variables[name]
        kind = pa.from_numpy_dtype(variable.dtype)
        if len(variable.shape) > 1:
            kind = pa.list_(kind, int(np.prod(variable.shape[1:])))
        own = {"dims": list(variable.dims), "shape": list(variable.shape[1:])}
        about = {**selection.attributes(name), **own}
        fields.append(pa.field(name, kind, metadata=_texts(about)))
    return pa.schema(fields, metadata=_texts(selection.attrs))


def _column(values: np.ndarray, shape: tuple[int, ...]) -> Any:
    import pyarrow as pa

    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if len(shape) > 1 else flat


def _texts(attrs: Any) -> dict[str, str]:
    """Return attributes as the texts that Parquet holds; lists are JSON."""
    return {
        name: value if isinstance(value, str) else json.dumps(np.asarray(value).tolist())
        for name, value in attrs.items()
    }
