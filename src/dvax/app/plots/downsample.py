"""One pass over the fields of a trajectory: what the pictures need, in memory a laptop has.

A map on a screen has a few hundred cells each way; a run may have 10^6 points and 10^3 frames. The
pass reads the trajectory block of frames by block of frames. It keeps, for every cell of the map, the
weighted mean and the most common regime, and for every frame the exact shares of the boundary in each
regime, over all points.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dvax.app.plots.run_reader import RunRecord
from dvax.errors import input_error

REGIMES = ("unloaded", "active", "saturated")
SPACE_CELLS = 360
TIME_CELLS = 480
BLOCK_BYTES = 32 * 2**20


@dataclass(frozen=True)
class CellMaps:
    """Fields on a curve, reduced to cells. Arrays have shape (time cells, space cells).

    `common` is the regime (0, 1, 2) that covers most of the cell. Edges have one entry more than there
    are cells.
    """

    time_edges: np.ndarray
    space_edges: np.ndarray
    mean: np.ndarray
    common: np.ndarray
    points_per_cell: int
    frames_per_cell: int

    @property
    def reduced(self) -> bool:
        """Whether a cell gathers more than one stored value."""
        return self.points_per_cell * self.frames_per_cell > 1


@dataclass(frozen=True)
class Reduced:
    """The fields of a run, reduced in one pass. `shares` has shape (3, frames), its columns sum to one.

    `cells` is None on a surface, whose maps are read frame by frame (see `maps.py`).
    """

    shares: np.ndarray
    time_mean: np.ndarray
    pressure_low: float
    pressure_high: float
    cells: CellMaps | None


def edges(points: np.ndarray) -> np.ndarray:
    """Cell edges half-way between increasing points, the outer ones mirrored; shape (n + 1,)."""
    if len(points) == 1:
        half = 0.5 * (abs(float(points[0])) or 1.0)
        return np.array([points[0] - half, points[0] + half])
    middle = 0.5 * (points[1:] + points[:-1])
    first, last = 1.5 * points[0] - 0.5 * points[1], 1.5 * points[-1] - 0.5 * points[-2]
    return np.concatenate([[first], middle, [last]])


def blocks(run: RunRecord) -> Iterator[slice]:
    """Slices of frames that fit the memory budget, made of whole chunks of the store where these
    are not far larger: a part of a chunk costs as much to read as the whole."""
    chunk, count = run["pressure"].frames_per_chunk, len(run.time)
    frame_bytes = 8 * run["pressure"].points
    fitting = max(1, BLOCK_BYTES // frame_bytes)
    step = fitting if chunk * frame_bytes > 4 * BLOCK_BYTES else -(-fitting // chunk) * chunk
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))


def downsample(run: RunRecord) -> Reduced:
    """Read pressure and regime once. InputError where a regime is not 0, 1 or 2."""
    frames, points = len(run.time), run["pressure"].points
    weight = run.series("weight") / run.series("weight").sum()
    shares = np.empty((len(REGIMES), frames))
    time_mean = np.zeros(points)
    low, high = np.inf, -np.inf
    gather = _Gather(run) if len(run.boundary_shape) == 1 else None
    for block in blocks(run):
        pressure = run["pressure"].frames(block).astype(float, copy=False)
        regime = run["regime"].frames(block)
        _check_regime(run, regime, block)
        for kind in range(len(REGIMES)):
            shares[kind, block] = (regime == kind) @ weight
        time_mean += pressure.sum(axis=0) / frames
        if np.isfinite(pressure).any():
            low, high = min(low, np.nanmin(pressure)), max(high, np.nanmax(pressure))
        if gather is not None:
            gather.take(block, pressure, regime)
    return Reduced(shares, time_mean, float(low), float(high), gather and gather.maps())


def _check_regime(run: RunRecord, regime: np.ndarray, block: slice) -> None:
    wrong = (regime < 0) | (regime >= len(REGIMES))
    if wrong.any():
        frame, point = (int(i) for i in np.argwhere(wrong)[0])
        raise input_error(
            f"{run.directory / 'trajectory.zarr'}: regime[{block.start + frame}, {point}]",
            str(regime[frame, point]),
            "a regime is 0 (unloaded), 1 (active) or 2 (saturated)",
            "The store is damaged or was written by another tool; run again.",
        )


class _Gather:
    """Fold frames into cells: sums for the means, and the measure of each regime in a cell."""

    def __init__(self, run: RunRecord):
        place = run.series("s")
        frames, points = len(run.time), len(place)
        self.starts = starts(points, SPACE_CELLS)
        time_starts = starts(frames, TIME_CELLS)
        self.cell_of_frame = np.repeat(
            np.arange(len(time_starts)), np.diff(np.append(time_starts, frames))
        )
        self.weight = run.series("weight")
        self.space_edges = edges(place)[np.append(self.starts, points)]
        self.time_edges = edges(run.time)[np.append(time_starts, frames)]
        self.points_per_cell = -(-points // len(self.starts))
        self.frames_per_cell = -(-frames // len(time_starts))
        shape = (len(time_starts), len(self.starts))
        self.sum = np.zeros(shape)
        self.measure = np.zeros((len(REGIMES), *shape))

    def take(self, block: slice, pressure: np.ndarray, regime: np.ndarray) -> None:
        into, starts = self.cell_of_frame[block], self.starts
        np.add.at(self.sum, into, np.add.reduceat(pressure * self.weight, starts, axis=1))
        for kind in range(len(REGIMES)):
            covered = np.where(regime == kind, self.weight, 0.0)
            np.add.at(self.measure[kind], into, np.add.reduceat(covered, starts, axis=1))

    def maps(self) -> CellMaps:
        # Every point of a cell is in exactly one regime, so the measures add up to the cell's own.
        whole = self.measure.sum(axis=0)
        return CellMaps(
            time_edges=self.time_edges,
            space_edges=self.space_edges,
            mean=self.sum / whole,
            common=self.measure.argmax(axis=0).astype(np.int8),
            points_per_cell=self.points_per_cell,
            frames_per_cell=self.frames_per_cell,
        )


def centres(edges: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The points of cells with these edges where each has one, else the middles of the cells."""
    return points if len(points) == len(edges) - 1 else 0.5 * (edges[1:] + edges[:-1])


def rounded(values: np.ndarray) -> np.ndarray:
    """Return values in single precision, rounded to 13 bits, the four digits that a map shows: such
    data compress to half their size."""
    single = np.asarray(values, np.float32)
    near = ((single.view(np.int32) + (1 << 9)) & ~((1 << 10) - 1)).view(np.float32)
    # NaN and infinity stay what they are, and so do values that would round to infinity.
    return np.where(np.isfinite(near), near, single)


def starts(count: int, cells: int) -> np.ndarray:
    """Where each of at most `cells` nearly equal groups of `count` items begins."""
    groups = min(count, cells)
    return (np.arange(groups) * count) // groups
