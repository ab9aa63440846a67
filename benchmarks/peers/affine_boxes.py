"""Random variational inequalities of known solution: F(y) = My + q on a box, M not symmetric.

M = S + K with the eigenvalues of S spread evenly over [0.5, 10] in a random basis, K skew of norm 5,
so that μ = 0.5. The solution is drawn first, then a third of the entries is put on each bound with
F away from 0 there, and q follows: q = w − My* is exact up to its rounding.
"""

from typing import NamedTuple

import numpy as np

_LEAST_EIGENVALUE, _LARGEST_EIGENVALUE, _SKEW_NORM = 0.5, 10.0, 5.0


class Affine(NamedTuple):
    """`M` (count, n, n); the others (count, n), `solution` with lower ≤ y* ≤ upper among them."""

    M: np.ndarray
    q: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    solution: np.ndarray


def affine_boxes(n: int, count: int = 1, seed: int = 0) -> Affine:
    rng = np.random.default_rng(seed)
    made = [_one(n, rng) for _ in range(count)]
    return Affine(*(np.stack(part) for part in zip(*made)))


def _one(n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    basis, _ = np.linalg.qr(rng.standard_normal((n, n)))
    skew = rng.standard_normal((n, n))
    skew = skew - skew.T
    M = (
        basis * np.linspace(_LEAST_EIGENVALUE, _LARGEST_EIGENVALUE, n)
    ) @ basis.T + skew * _SKEW_NORM / np.linalg.norm(skew, 2)
    y = rng.uniform(-1.0, 1.0, n)
    where = rng.integers(0, 3, n)
    lower = np.where(where == 0, y, y - rng.uniform(0.1, 1.0, n))
    upper = np.where(where == 1, y, y + rng.uniform(0.1, 1.0, n))
    push = rng.uniform(0.1, 1.0, n)
    w = np.where(where == 0, push, np.where(where == 1, -push, 0.0))
    return M, w - M @ y, lower, upper, y
