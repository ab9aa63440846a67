"""The blocks of saved frames in which a contact law is solved, one `dvax.solve` each."""

import math
from collections.abc import Iterator

import numpy as np

_BLOCKS = 40
"""So many blocks at least where there are frames enough: the progress bar moves, and a kill loses
no more than a fortieth."""
_BLOCK_BYTES = 2**27


def block_length(frames: int, points: int) -> int:
    """Frames a block: a fortieth of all, fewer where they are large, and never the first alone,
    which is no distance from the start."""
    affordable = _BLOCK_BYTES // (8 * 3 * points)
    longest = max(2, min(math.ceil(frames / _BLOCKS), affordable))
    return math.ceil(frames / math.ceil(frames / longest))


def longest_block(times: np.ndarray, points: int) -> float:
    """The longest time that one solve covers, from the last frame before a block to its last one."""
    return max(end - start for start, end in _spans(times, block_length(len(times), points)))


def _spans(times: np.ndarray, block: int) -> Iterator[tuple[float, float]]:
    for first in range(0, len(times), block):
        last = min(first + block, len(times)) - 1
        yield float(times[max(first - 1, 0)]), float(times[last])
