"""Strongly pseudomonotone operators a(y)(Ay + b), not monotone, with known solutions and moduli."""

import numpy as np

from dvax.sets import Ball, Box, HalfSpace, Simplex

SIZE = 5
COUNT = 500

# a(y) with its least value m, its largest M on ‖y‖ ≤ R, and its Lipschitz constant: F = a·(Ay + b) is
# strongly pseudomonotone with γ = m μ wherever A is strongly monotone with μ, since
# ⟨F(y*), y − y*⟩ ≥ 0 says ⟨Ay* + b, y − y*⟩ ≥ 0, whence ⟨Ay + b, y − y*⟩ ≥ μ‖y − y*‖².
WEIGHTS = {
    "a bell": (lambda xp, y: xp.exp(-xp.sum(y * y, -1)) + 0.3, 0.3, 1.3, np.sqrt(2 / np.e)),
    "a wave": (lambda xp, y: 2.0 + xp.sin(3.0 * xp.sum(y, -1)), 1.0, 3.0, 3.0 * np.sqrt(SIZE)),
    "a fraction": (lambda xp, y: 1.0 / (1.0 + xp.sum(y * y, -1)) + 0.1, 0.1, 1.1, 0.65),
    "a slope": (lambda xp, y: 1.5 + xp.tanh(4.0 * y[..., 0] - y[..., 1]), 0.5, 2.5, np.sqrt(17.0)),
}
REACH = (
    4.0  # all points lie in ‖y‖ ≤ REACH, where F has the Lipschitz constant M‖A‖ + Lip(a)‖Ay + b‖
)


# From (y*, unit vectors n, lengths s ≥ 0): data of a set with y* on its boundary, and a normal there.
def box(y, n, s, rng):
    place = rng.integers(-1, 2, y.shape)
    gap = rng.exponential(size=(2, *y.shape))
    lower, upper = np.where(place < 0, y, y - gap[0]), np.where(place > 0, y, y + gap[1])
    return (lower, upper), place * np.abs(n) * s[:, None]


def ball(y, n, s, rng):
    radius = rng.uniform(0.2, 2.0, len(y))
    return (y - radius[:, None] * n, radius), n * s[:, None]


def half_space(y, n, s, rng):
    return (n, np.sum(n * y, axis=1)), n * s[:, None]


def simplex(y, n, s, rng):
    # Normal to the shares at y: one number on the support, less off it.
    level = rng.normal(size=(len(y), 1))
    return (np.sum(y, axis=1),), level - np.where(y > 0, 0.0, np.abs(n) * s[:, None])


KINDS = {
    "box": (box, Box), "ball": (ball, Ball), "half-space": (half_space, HalfSpace),
    "simplex": (simplex, Simplex),
}  # fmt: skip


def cases(kind, rng, weight):
    """Problems made backwards from y*: b with −(Ay* + b) ∈ N_K(y*), which a(y) > 0 does not change."""
    y = rng.normal(size=(COUNT, SIZE)) * 0.6
    if kind == "simplex":
        y = rng.dirichlet(np.ones(SIZE), COUNT) * (rng.random((COUNT, SIZE)) < 0.6)
        y[:, 0] += 0.05
    n = rng.normal(size=(COUNT, SIZE))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    data, normal = KINDS[kind][0](
        y, n, rng.exponential(size=COUNT) * rng.integers(0, 2, COUNT), rng
    )
    root, skew = rng.normal(size=(2, COUNT, SIZE, SIZE))
    A = root @ root.swapaxes(1, 2) / SIZE + (skew - skew.swapaxes(1, 2)) / 2
    wanted = 10.0 ** rng.uniform(-1, 0, COUNT)
    least = np.linalg.eigvalsh(0.5 * (A + A.swapaxes(1, 2)))[:, 0]
    A = A + (wanted - least)[:, None, None] * np.eye(SIZE)
    b = -normal - np.einsum("kij,kj->ki", A, y)
    _, low, high, steep = WEIGHTS[weight]
    norm = np.linalg.norm(A, 2, axis=(1, 2))
    L = high * norm + steep * (norm * REACH + np.linalg.norm(b, axis=1))
    return data, A, b, low * wanted, L, y
