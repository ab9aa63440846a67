"""Projections onto the sets of dvax by hand, in NumPy."""

from itertools import combinations, product
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]


def ball(z: Array, center: Any, radius: float) -> Array:
    offset = z - center
    length = np.sqrt(offset @ offset)
    return z if length <= radius else center + offset * (radius / length)


def half_space(z: Array, normal: Array, offset: float) -> Array:
    excess = normal @ z - offset
    return z if excess <= 0 else z - normal * (excess / (normal @ normal))


def hyperplane(z: Array, normal: Array, offset: float) -> Array:
    return z - normal * ((normal @ z - offset) / (normal @ normal))


def simplex(z: Array, total: float) -> Array:
    falling = np.sort(z)[::-1]
    tau = (np.cumsum(falling) - total) / np.arange(1, len(z) + 1)
    return np.maximum(z - tau[np.flatnonzero(falling > tau)[-1]], 0.0)


def l1_ball(z: Array, radius: float) -> Array:
    size = np.abs(z)
    return z if np.sum(size) <= radius else np.sign(z) * simplex(size, radius)


def second_order_cone(z: Array, slope: float) -> Array:
    height, across = z[0], z[1:]
    length = np.sqrt(across @ across)
    if length <= slope * height:
        return z
    s = (height + slope * length) / (1.0 + slope * slope)
    return np.zeros_like(z) if s <= 0 else np.append(s, across * (slope * s / length))


def ellipsoid(z: Array, radii: Array) -> Array:
    """λ ≥ 0 with Σ (rᵢzᵢ/(rᵢ² + λ))² = 1, by Newton's method from the left, where it is monotone."""
    square = radii * radii
    scaled = (radii * z) ** 2
    if np.sum(scaled / square**2) <= 1.0:
        return z
    lam = 0.0
    for _ in range(60):
        each = scaled / (square + lam) ** 2
        norm = np.sqrt(np.sum(each))
        step = (norm - 1.0) * norm * norm / np.sum(each / (square + lam))
        lam += step
        if abs(step) <= 1e-15 * (lam + square.min()):
            break
    return z * (square / (square + lam))


def polyhedron(z: Array, faces: list[tuple], G: Array, d: Array) -> Array:
    """The nearest of the projections onto faces that lies in {G y ≤ d}: with `faces_of` a few rows."""
    best, answer = np.inf, np.full_like(z, np.nan)
    slack = 1e-12 * (1.0 + np.max(np.abs(d)))
    for rows, back in faces:
        y = z - back @ (G[rows] @ z - d[rows]) if rows else z
        if np.all(G @ y - d <= slack):
            distance = (y - z) @ (y - z)
            if distance < best:
                best, answer = distance, y
    return answer


def faces_of(G: Array) -> list[tuple]:
    """(active rows, their pseudoinverse) for every independent choice."""
    every = [
        (list(r), len(r)) for k in range(G.shape[1] + 1) for r in combinations(range(len(G)), k)
    ]
    return [
        (rows, np.linalg.pinv(G[rows]))
        for rows, k in every
        if k == 0 or np.linalg.matrix_rank(G[rows]) == k
    ]


def box_and_total(z: Array, lower: Array, upper: Array, total: float) -> Array:
    """{lower ≤ y ≤ upper, Σy = total}: y = clip(z − τ) with the τ between two of the breakpoints."""
    points = np.sort(np.concatenate([z - lower, z - upper]))
    sums = np.sum(np.clip(z[None] - points[:, None], lower, upper), axis=1)  # falls with τ
    k = int(np.clip(np.searchsorted(-sums, -total), 1, len(points) - 1))
    fall = sums[k - 1] - sums[k]
    share = (sums[k - 1] - total) / fall if fall > 0 else 0.0
    return np.clip(z - (points[k - 1] + share * (points[k] - points[k - 1])), lower, upper)


def ball_and_half_space(z: Array, radius: float, normal: Array, offset: float) -> Array:
    """In the plane, the ball about 0: on one of the two, or where their boundaries meet."""
    if z @ z <= radius * radius and normal @ z <= offset:
        return z
    on_ball = ball(z, 0.0, radius)
    if normal @ on_ball <= offset:
        return on_ball
    on_plane = half_space(z, normal, offset)
    if on_plane @ on_plane <= radius * radius:
        return on_plane
    foot = normal * (offset / (normal @ normal))
    along = np.array([-normal[1], normal[0]]) / np.sqrt(normal @ normal)
    reach = np.sqrt(radius * radius - foot @ foot)
    return foot + along * (reach if along @ z > 0 else -reach)


def affine_box(z: Array, faces: list[tuple], lower: Array, upper: Array) -> Array:
    """The y with My − z ∈ −N_K(y), K a box, M with positive definite symmetric part: the face whose
    solution breaks no condition by more than rounding. `faces` from `faces_of_box(M)`."""
    least, answer = np.inf, np.full_like(z, np.nan)
    for held, free, inverse, coupling, M in faces:
        y = np.where(held < 0, lower, np.where(held > 0, upper, 0.0))
        if len(free):
            y[free] = inverse @ (z[free] - coupling @ y)
        F = M @ y - z
        broken = np.where(
            held < 0, -F, np.where(held > 0, F, np.maximum(lower - y, y - upper))
        ).max()
        if broken < least:
            least, answer = broken, y
            if broken <= 0.0:
                break
    return answer


def faces_of_box(M: Array) -> list[tuple]:
    found = []
    for face in product((0, -1, 1), repeat=len(M)):
        held = np.array(face)
        free = np.flatnonzero(held == 0)
        coupling = np.where(held[None] == 0, 0.0, M[free])
        inverse = np.linalg.inv(M[np.ix_(free, free)]) if len(free) else None
        found.append((held, free, inverse, coupling, M))
    return found
