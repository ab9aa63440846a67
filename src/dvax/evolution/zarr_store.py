"""A Zarr store that saved rows are written into while a run goes on."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from .._files import consolidate
from ..errors import input_error
from .solution import Solution

_CHUNK_BYTES = 2**23


class ZarrStore:
    """The saved times, states and responses of a run in a folder, for `dvax.solve(save=…)`.

    The folder is an xarray Dataset (`xarray.open_zarr`) with the variables of `Solution.to_xarray`:
    time, x, u, y, and where they are there, law_error and defect. It is readable while the run goes on,
    and after a kill: the time of a row is written last, and metadata end with the last complete row.
    Chunks have at most 8 MB.

    - `path`: the folder; its parent exists;
    - `overwrite`: whether to replace a store that is there.

    **Raises:** `dvax.InputError` if there is something at `path`; `ModuleNotFoundError` if zarr and
    xarray (the extra `dvax[app]`) are not installed.

    ```python
    >>> import tempfile, dvax, numpy as np, xarray
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     store = dvax.ZarrStore(folder + "/run.zarr")
    ...     end = dvax.solve(problem, -1.0, 0.0, 2.0, ts=np.linspace(0.0, 2.0, 5), save=store)
    ...     with xarray.open_zarr(store.path) as data:
    ...         rows = data.x.values
    >>> len(end.xs), rows.shape, bool(rows[-1] == end.xs[0])
    (1, (5,), True)

    ```
    """

    def __init__(self, path: str | Path, *, overwrite: bool = False):
        import xarray  # noqa: F401  (a missing extra is reported before the run)
        import zarr  # noqa: F401

        self.path = Path(path)
        self.complete_rows = 0
        """The number of complete rows."""
        self._overwrite = overwrite
        self._arrays: dict[str, Any] = {}

    def begin(self, count: int) -> None:
        """Make room for `count` rows. `dvax.solve` calls it before the run."""
        if self.path.exists() and not (self._overwrite and _is_store(self.path)):
            raise input_error(
                "dvax.ZarrStore(path)", str(self.path), "there is something at this path",
                "Give another path, or overwrite=True for a Zarr store",
            )  # fmt: skip
        shutil.rmtree(self.path, ignore_errors=True)
        self.complete_rows, self._count, self._arrays = 0, count, {}

    def write(self, rows: Solution) -> None:
        """Append the rows of a solution; their times are written last. **Raises:** `OSError`."""
        data = rows.to_xarray()
        if not self._arrays:
            self._create(data)
        region = slice(self.complete_rows, self.complete_rows + data.sizes["time"])
        for name in (*data.data_vars, "time"):
            self._arrays[str(name)][region] = data[name].values
        self.complete_rows = region.stop
        consolidate(self.path, self.complete_rows)

    def finish(self) -> None:
        """Cut off the rows that were not reached."""
        for array in self._arrays.values():
            if array.shape[0] != self.complete_rows:
                array.resize((self.complete_rows, *array.shape[1:]))
        if self._arrays:
            consolidate(self.path, self.complete_rows)

    def _create(self, data: Any) -> None:
        import zarr

        attributes = {**data.attrs, "coordinates": "time"}
        group = zarr.open_group(self.path, mode="w-", zarr_format=3, attributes=attributes)
        for name in (*data.data_vars, "time"):
            values, about = data[name].values, dict(data[name].attrs)
            row = max(1, values[0].nbytes)
            chunks = [max(1, min(len(values), _CHUNK_BYTES // row)), *values.shape[1:]]
            if row > _CHUNK_BYTES:
                chunks[-1] = max(1, chunks[-1] * _CHUNK_BYTES // row)
            self._arrays[str(name)] = group.create_array(
                str(name), shape=(self._count, *values.shape[1:]), chunks=tuple(chunks),
                dtype=values.dtype, fill_value=np.nan, dimension_names=data[name].dims,
                attributes=about,
            )  # fmt: skip


def _is_store(path: Path) -> bool:
    """Return whether a folder is a Zarr store, which alone may be replaced."""
    return (path / "zarr.json").is_file()
