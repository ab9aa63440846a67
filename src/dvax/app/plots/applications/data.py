"""The results of an application as a run directory keeps them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr


@dataclass(frozen=True)
class Data:
    """An array, its dimensions, its unit and what it is."""

    values: np.ndarray
    dims: tuple[str, ...]
    unit: str
    words: str
    status: str = ""
    """Of a bound, how much is known of it: proved, declared or estimated."""


def read_data(store: Path) -> dict[str, Data]:
    """Every variable of the store.

    **Raises:** `OSError`, `ValueError` or `KeyError` where it is damaged.
    """
    group = zarr.open_group(store, mode="r")
    found = {}
    for name, array in group.arrays():
        attrs = dict(array.attrs)
        dims = tuple(str(d) for d in getattr(array.metadata, "dimension_names", None) or ())
        found[name] = Data(
            np.asarray(array[...]),
            dims,
            str(attrs.get("units", "")),
            str(attrs.get("long_name", "")),
            str(attrs.get("status", "")),
        )
    return found
