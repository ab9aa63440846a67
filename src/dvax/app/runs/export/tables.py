"""Variables with the same first dimension as the columns of a table."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dvax.app.runs.export.selection import Selection, blocks


@dataclass(frozen=True)
class Table:
    """The variables whose first dimension is `dim`, with `rows` rows; "" is that of numbers without a
    dimension. `has_index`: its first column counts the rows, since no coordinate does."""

    dim: str
    rows: int
    names: tuple[str, ...]
    has_index: bool

    def blocks(self, selection: Selection) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
        """Return the rows block by block, each variable flattened to (rows, entries)."""
        of = {name: selection.variables[name] for name in self.names}
        if not self.dim:
            yield slice(0, 1), {n: np.asarray(v.values).reshape(1, 1) for n, v in of.items()}
            return
        for block in blocks(list(of.values()), self.rows):
            count = block.stop - block.start
            yield block, {n: v.frames(block).reshape(count, -1) for n, v in of.items()}


def tables(selection: Selection) -> list[Table]:
    """Return the tables of a selection, that over time first. Coordinates are columns of the table of
    their dimension, in front."""
    by_dim: dict[str, list[str]] = {}
    for name in (*selection.coordinates, *selection.data):
        dims = selection.variables[name].dims
        by_dim.setdefault(dims[0] if dims else "", []).append(name)
    order = sorted(by_dim, key=lambda dim: dim != "time")
    return [_table(selection, dim, by_dim[dim]) for dim in order]


def _table(selection: Selection, dim: str, names: list[str]) -> Table:
    rows = selection.variables[names[0]].shape[0] if dim else 1
    ordered = [dim] * (dim in names) + [n for n in names if n != dim]
    return Table(dim, rows, tuple(ordered), bool(dim) and dim not in names)
