"""The blocks of saved frames in which a contact law is solved, one `dvax.solve` each."""

import math
from collections.abc import Iterator

import numpy as np

_BLOCKS = 40
"""The least number of blocks of a run with at least as many frames: the progress bar moves, and a
killed run loses at most a fortieth."""
_BLOCK_BYTES = 2**27


def block_length(frames: int, points: int) -> int:
    """Return the number of frames per block: a fortieth of all, fewer where frames are large. It is at
    least 2, since the first frame is the initial state."""
    affordable = _BLOCK_BYTES // (8 * 3 * points)
    longest = max(2, min(math.ceil(frames / _BLOCKS), affordable))
    return math.ceil(frames / math.ceil(frames / longest))


def longest_block(times: np.ndarray, points: int) -> float:
    """Return the longest time that one solve covers, from the last frame before a block to its last."""
    return max(end - start for start, end in _spans(times, block_length(len(times), points)))


def _spans(times: np.ndarray, block: int) -> Iterator[tuple[float, float]]:
    for first in range(0, len(times), block):
        last = min(first + block, len(times)) - 1
        yield float(times[max(first - 1, 0)]), float(times[last])
