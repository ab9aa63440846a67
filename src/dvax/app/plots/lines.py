"""Thin curves over time to the resolution of a screen without losing a peak."""

import numpy as np

MOST_POINTS = 4000
LARGEST = 1e200


def thin(time: np.ndarray, values: np.ndarray, most: int = MOST_POINTS) -> np.ndarray:
    """Indices to draw: all, or in each of `most`/2 groups the lowest and the highest value.

    The first and last frames are always among them. `values` has the shape of `time`; a group
    without a finite value keeps its first frame, so that a gap stays a gap.
    """
    count = len(time)
    if count <= most:
        return np.arange(count)
    starts = (np.arange(most // 2) * count) // (most // 2)
    stops = np.append(starts[1:], count)
    keep = {0, count - 1}
    for start, stop in zip(starts, stops, strict=True):
        part = values[start:stop]
        if not np.isfinite(part).any():
            keep.add(int(start))
            continue
        keep.update((int(start + np.nanargmin(part)), int(start + np.nanargmax(part))))
    return np.array(sorted(keep))


def positive(values: np.ndarray) -> np.ndarray:
    """The values a logarithmic axis can show; the others become gaps: zero, negative and infinite ones,
    and those above `LARGEST`, next to which the margins of the axis would overflow."""
    return np.where((values > 0) & (values <= LARGEST), values, np.nan)
