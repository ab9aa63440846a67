"""The contact boundary Gamma_C as points with quadrature weights."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvax.app.runs.schema import BoundarySection
from dvax.app.runs.units import Units
from dvax.errors import InputProblem, Problems, input_error
from dvax.formats.csv_columns import check_increasing, read_columns


@dataclass(frozen=True)
class Boundary:
    """n points: `coordinates` (one array (n,) a direction) and `weights` (n,), their measures.

    `shape` is (n,) or, for a rectangle, (n1, n2) with the points in C order. The weights make the
    sum of w(s) v(s)^2 the squared norm of L2(Gamma_C); for midpoints they are the measures of the
    cells.
    """

    coordinates: tuple[np.ndarray, ...]
    weights: np.ndarray
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        return self.weights.size

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the coordinates in formulas."""
        return ("s",) if len(self.coordinates) == 1 else ("s1", "s2")

    def nearest(self, place: Sequence[float]) -> int:
        """The index of the point nearest to a place."""
        pairs = zip(self.coordinates, place, strict=True)
        return int(np.argmin(sum((c - p) ** 2 for c, p in pairs)))


def build_boundary(section: BoundarySection, nodes: Path | None, units: Units) -> Boundary:
    """Midpoints of equal cells (error O(h^2) of integrals), or the nodes of a file.

    Raises `InputError` with every problem of the file.
    """
    if nodes is not None:
        return _from_file(nodes, units)
    assert section.points is not None  # the section has been checked
    lengths = section.lengths or [section.length or 0.0]
    cells = [length / n for length, n in zip(lengths, section.points, strict=True)]
    grid = np.meshgrid(
        *(cell * (np.arange(n) + 0.5) for cell, n in zip(cells, section.points, strict=True)),
        indexing="ij",
    )
    weights = np.full(math.prod(section.points), math.prod(cells))
    return Boundary(tuple(c.ravel() for c in grid), weights, tuple(section.points))


def _from_file(path: Path, units: Units) -> Boundary:
    s, weight = read_columns(path, ["s", "weight"], "s")
    check_increasing(path.name, s)
    problems = Problems()
    columns = []
    for column in (s, weight):
        # An infinite coordinate is refused by check_size.
        with problems.collect(), np.errstate(over="ignore"):
            columns.append(units.values(path.name, column, "length"))
    problems += [
        InputProblem(
            f"{path.name}, line {weight.lines[i]}, column 'weight'",
            f"{weight.values[i]:g}",
            "a quadrature weight is the length that a node stands for and is greater than 0",
            "Give a positive weight or remove the node.",
        )
        for i in np.flatnonzero(~(weight.values > 0))[:20]
    ]
    problems.raise_any()
    places, weights = columns
    return Boundary((places,), weights, (places.size,))


def check_size(boundary: Boundary, place: str) -> None:
    """Raise `InputError` where distances and norms on the boundary would not be numbers."""
    farthest = max(float(np.abs(c).max()) for c in boundary.coordinates)
    least, most = float(boundary.weights.min()), float(boundary.weights.max())
    if farthest <= 1e100 and least >= 1e-200 and most <= 1e200:
        return
    raise input_error(
        place,
        f"coordinates up to {farthest:g} and weights from {least:g} to {most:g}",
        "coordinates are at most 1e100 and weights between 1e-200 and 1e200, or squares of them "
        "overflow",
        "Choose a unit of length nearer to the size of the boundary.",
    )
