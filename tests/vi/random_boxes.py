"""Random affine variational inequalities on boxes, with solutions found without projections.

Every case is VI({lower ≤ y ≤ upper}, My + q) in `SIZE` unknowns with M nonsymmetric and ⟨Mv, v⟩ ≥ γ‖v‖²
for a γ that is known. Smaller cases are filled up by entries of zero width. Three families:

- six unknowns, solved by trying all 3⁶ faces;
- ten unknowns, by principal pivoting, least index first (Murty 1974; for two bounds Júdice and Pires
  1992), which ends for every P-matrix and shares with the library neither step nor projection;
- ten unknowns made backwards from a solution, in binary fractions so short that My* + q is exact: so is
  the solution, whatever γ, and at bounds where F vanishes.
"""

from itertools import product
from typing import NamedTuple

import numpy as np

SIZE = 10
SMALL = 6


class Boxes(NamedTuple):
    """`y` is the solution to a few roundings of the size of ‖M_free⁻¹‖; exact for the third family."""

    matrix: np.ndarray
    q: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    gamma: np.ndarray
    L: np.ndarray
    y: np.ndarray
    family: np.ndarray


def on_face(matrix, q, lower, upper, face):
    """y with its entries held below (−1), above (1), or solving their own equations (0); F(y)."""
    bound = np.where(face < 0, lower, np.where(face > 0, upper, 0.0))
    held = face != 0
    system = np.where(held[:, :, None], np.eye(q.shape[1]), matrix)
    y = np.linalg.solve(system, np.where(held, bound, -q)[:, :, None])[:, :, 0]
    y = np.where(held, bound, y)
    return y, np.einsum("kij,kj->ki", matrix, y) + q


def violation(y, F, lower, upper, face):
    free = np.maximum(np.maximum(lower - y, y - upper), 0.0)
    return np.where(face == 0, free, np.maximum(face * F, 0.0))


def by_faces(matrix, q, lower, upper):
    """The face whose point violates no condition by more than rounding."""
    best, answer = np.full(len(q), np.inf), np.full_like(q, np.nan)
    for signs in product((-1, 0, 1), repeat=q.shape[1]):
        face = np.broadcast_to(np.array(signs), q.shape)
        real = ~np.any(np.isinf(np.where(face < 0, lower, np.where(face > 0, upper, 0.0))), axis=1)
        given = [a[real] for a in (matrix, q, lower, upper, face)]
        y, F = on_face(*given)
        worst = np.max(violation(y, F, *given[2:]), axis=1)
        better = worst < best[real]
        place = np.flatnonzero(real)[better]
        best[place], answer[place] = worst[better], y[better]
    return answer


def by_pivoting(matrix, q, lower, upper):
    """Start with all entries free where possible, and change the first wrong entry repeatedly."""
    face = np.where(lower == upper, -1, 0)
    answer, open_ = np.full_like(q, np.nan), np.arange(len(q))
    for _ in range(2000):
        given = [a[open_] for a in (matrix, q, lower, upper, face)]
        y, F = on_face(*given)
        # Entries of zero width are held for good.
        wrong = violation(y, F, *given[2:]) * (given[2] < given[3])
        size = 1e-12 * (1 + np.max(np.abs(y), axis=1) + np.max(np.abs(given[1]), axis=1))
        bad = wrong > size[:, None]
        done = ~np.any(bad, axis=1)
        answer[open_[done]] = y[done]
        first = np.argmax(bad, axis=1)[~done]
        rows = open_[~done]
        now = face[rows, first]
        turned = np.where(y[~done, first] < lower[rows, first], -1, 1)
        face[rows, first] = np.where(now != 0, 0, turned)
        open_ = rows
        if len(open_) == 0:
            return answer
    return answer


def drawn(rng, count, size):
    """(M, q, lower, upper, γ, L): strongly monotone, a third of the bounds infinite, some tight."""
    root, skew = rng.normal(size=(2, count, size, size))
    steep = rng.uniform(0, 3, (count, 1, 1))
    M = root @ root.swapaxes(1, 2) / size + steep * (skew - skew.swapaxes(1, 2)) / size
    least = np.linalg.eigvalsh(0.5 * (M + M.swapaxes(1, 2)))[:, 0]
    wanted = 10.0 ** rng.uniform(-3, 0, count)
    M = M + (wanted - least)[:, None, None] * np.eye(size)
    q = rng.normal(size=(count, size)) * 10.0 ** rng.uniform(-1, 1, (count, 1))
    lower = rng.normal(size=(count, size))
    upper = lower + rng.exponential(size=(count, size)) * (rng.random((count, size)) < 0.85)
    wide = rng.random((2, count, size)) < 0.2
    lower, upper = np.where(wide[0], -np.inf, lower), np.where(wide[1], np.inf, upper)
    return M, q, lower, upper


def degenerate(rng, M, q, lower, upper, y):
    """q with F = 0, but for rounding, at a third of the entries that a bound holds: y still solves."""
    F = np.einsum("kij,kj->ki", M, y) + q
    held = (y == lower) | (y == upper)
    return q - np.where(held & (rng.random(q.shape) < 1 / 3), F, 0.0)


def moduli(M):
    """Bounds on γ and L, each on the safe side of its rounding error."""
    L = np.linalg.norm(M, 2, axis=(1, 2)) * (1 + 1e-12)
    return np.linalg.eigvalsh(0.5 * (M + M.swapaxes(1, 2)))[:, 0] - 1e-14 * L, L


def filled(rng, M, q, lower, upper, y):
    """The same case with further unknowns of zero width, inserted anywhere."""
    count, size = q.shape
    more = SIZE - size
    point = rng.normal(size=(count, more))
    big = np.tile(np.eye(SIZE), (count, 1, 1))
    big[:, :size, :size] = M
    joined = [
        big,
        np.hstack([q, rng.normal(size=(count, more))]),
        *(np.hstack([own, point]) for own in (lower, upper, y)),
    ]
    order = rng.permuted(np.tile(np.arange(SIZE), (count, 1)), axis=1)
    rows = np.take_along_axis(joined[0], order[:, :, None], axis=1)
    matrix = np.take_along_axis(rows, order[:, None, :], axis=2)
    return matrix, *(np.take_along_axis(own, order, axis=1) for own in joined[1:])


def made_backwards(rng, count):
    """Exact in binary: M = BᵀB + (S − Sᵀ) + γ1 in integers but for γ, a power of two, B of rank 6."""
    B = rng.integers(-2, 3, (count, SMALL, SIZE)).astype(float)
    S = rng.integers(-3, 4, (count, SIZE, SIZE)).astype(float)
    gamma = rng.choice([2.0**-33, 2.0**-10, 1.0], count)
    M = B.swapaxes(1, 2) @ B + S - S.swapaxes(1, 2) + gamma[:, None, None] * np.eye(SIZE)
    y = rng.integers(-12, 13, (count, SIZE)) / 4.0
    place = rng.integers(-1, 2, (count, SIZE))  # below, between, above
    # For one in four, no entry is free: then no equation is solved with the modulus γ.
    corner = rng.random((count, 1)) < 0.25
    place = np.where(corner & (place == 0), 1, place)
    gap = rng.integers(1, 9, (2, count, SIZE)) / 4.0
    gap = np.where(rng.random((2, count, SIZE)) < 0.2, np.inf, gap)
    gap = np.where(rng.random((2, count, SIZE)) < 0.1, 0.0, gap)
    lower, upper = np.where(place < 0, y, y - gap[0]), np.where(place > 0, y, y + gap[1])
    # F points inwards at a bound, or is nothing; between the bounds it is nothing.
    push = rng.integers(0, 4, (count, SIZE)) / 4.0
    q = -np.where(place == 0, 0.0, place) * push - np.einsum("kij,kj->ki", M, y)
    return M, q, lower, upper, y, gamma, np.linalg.norm(M, 2, axis=(1, 2)) * (1 + 1e-12)


def boxes(seed, count):
    """`count` cases, two fifths of the first and second family each."""
    rng = np.random.default_rng(seed)
    part = 2 * count // 5
    families = []
    for size, solve in ((SMALL, by_faces), (SIZE, by_pivoting)):
        M, q, lower, upper = drawn(rng, part, size)
        y = solve(M, q, lower, upper)
        q = degenerate(rng, M, q, lower, upper, y)
        M, q, lower, upper, y = filled(rng, M, q, lower, upper, y)
        families.append((M, q, lower, upper, *moduli(M), y))
    M, q, lower, upper, y, gamma, L = made_backwards(rng, count - 2 * part)
    families.append((M, q, lower, upper, gamma, L, y))
    label = np.repeat([0, 1, 2], [part, part, count - 2 * part])
    return Boxes(*(np.concatenate(parts) for parts in zip(*families)), label)
