"""Beckmann's problem over given paths, by projected Newton steps for blocks of pairs in turn.

    min Φ(Δx) over x ≥ 0 whose paths sum up to the demand of every pair.

A Newton step for all pairs at once moves too many of them onto the same links: thousands of pairs
share two alternatives, and each would move all of its flow. So the pairs are divided into blocks, and
a block's step starts from the link flows that the blocks before it left (Gauss–Seidel). Within a
block the pairs are coupled by the Hessian: the conjugate gradient method minimises the quadratic
model of Φ on the paths that carry flow after a scaled projected gradient step (Bertsekas 1982), and
on smaller faces while paths would carry less than nothing. Every step ends in an exact line search.

Only pairs with two paths or more have a choice, and only the links that not all paths of a pair share
change its costs: all others are constants here.
"""

import itertools
from typing import Any

import numpy as np

from .costs import LinkCosts
from .paths import Paths

_BLOCK = 50_000
_BLOCKS = 32
"""Entries of a block, about: of fewer, NumPy's overhead of 1 ms a step is the largest part. With 32
blocks Chicago's sketch network needs a third of the sweeps that it needs with one."""

_SCALES = 0.5, 0.05, 0.005
"""Lengths of the scaled gradient step that predicts which paths are used. A full one overshoots for
pairs that share links: half of it needs two thirds of the steps on Chicago's sketch network."""

_SHORT = 0.25
"""A step of which the line search leaves less is computed again, with a shorter prediction and with
larger slopes."""

_FACES = 5
"""Faces that a step tries, each a part of the one before."""

_REDUCTION = 0.1
_MOST_PRODUCTS = 200
"""The conjugate gradient method reduces the residual by this factor, within so many products."""

_LEVEL = 1e-15
"""The slope of Φ at the end of a step is level below this share of the cost of all trips. Flows that
move between paths of the same links change Φ by rounding alone, and the step that empties paths must
not be cut for it."""


class RestrictedProblem:
    """The problem over `paths`, from the flows `x` on.

    `flows()` are those it has reached; `shortest` is the smallest share of a step that a line search
    has left so far.
    """

    def __init__(
        self, costs: LinkCosts, capacity: np.ndarray, paths: Paths, demand: np.ndarray,
        x: np.ndarray, blocks: int | None = None,
    ) -> None:  # fmt: skip
        self.costs, self.capacity, self.start = costs, capacity, x
        rows = paths.differences(demand)
        self.rows, chosen = rows.rows, demand[rows.pairs]
        starts = np.append(np.cumsum(rows.sizes) - rows.sizes, len(rows.rows))
        ends = rows.ends[starts]
        if blocks is None:
            blocks = int(np.clip(ends[-1] // _BLOCK, 1, _BLOCKS))
        blocks = max(1, min(blocks, len(rows.sizes)))
        cuts = np.searchsorted(ends, np.linspace(0, ends[-1], blocks + 1))
        cuts[0], cuts[-1] = 0, len(rows.sizes)
        self.blocks = [
            _Block(
                rows.matrix(int(starts[a]), int(starts[b])), rows.sizes[a:b], chosen[a:b],
                x[rows.rows[starts[a] : starts[b]]],
            )
            for a, b in itertools.pairwise(cuts.tolist())
            if b > a
        ]  # fmt: skip
        self.shortest = 1.0
        self.v = sum((block.transposed @ block.x for block in self.blocks), rows.fixed)

    def sweep(self) -> None:
        """A step for every block."""
        for block in self.blocks:
            self.v, length = block.step(self.costs, self.capacity, self.v)
            self.shortest = min(self.shortest, length)

    def excess(self) -> float:
        """What all trips would save on the least cost paths of the set."""
        c = self.costs.costs(self.v, self.capacity)
        return float(sum(block.x @ block.gradient(c) for block in self.blocks))

    def flows(self) -> np.ndarray:
        """x on all paths."""
        x = self.start.copy()
        if self.blocks:
            x[self.rows] = np.concatenate([block.x for block in self.blocks])
        return x


class _Block:
    """Some of the pairs: `matrix` has a row a path, `sizes` counts those of each pair."""

    def __init__(self, matrix: Any, sizes: np.ndarray, demand: np.ndarray, x: np.ndarray) -> None:
        self.matrix, self.transposed = matrix, matrix.T
        self.sizes, self.demand, self.x = sizes, demand, x
        self.starts = np.cumsum(sizes) - sizes

    def step(
        self, costs: LinkCosts, capacity: np.ndarray, v: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Move x; return (what v, the link flows of all trips, become; the share of the step)."""
        c, D = costs.costs(v, capacity), costs.slopes(v, capacity)
        g = self.gradient(c)
        best, reached, share = 0.0, (self.x, v), 1.0
        for scale in _SCALES:
            target = self._target(g, D, scale)
            move = target - self.x
            descent = -float(g @ move)
            if not descent > 0:
                break
            dv = self.transposed @ move
            length = _line_search(costs, capacity, v, dv, _LEVEL * float(c @ v))
            if length * descent > best:
                x = target if length == 1.0 else np.maximum(self.x + length * move, 0.0)
                best, share = length * descent, length
                reached = x, np.maximum(v + length * dv, 0.0)
            if length >= _SHORT:
                break
            # The slopes at v, 0 on an empty link, are no measure of such a move: the mean ones are.
            rise = costs.costs(np.maximum(v + dv, 0.0), capacity) - c
            D = np.maximum(D, np.where(dv == 0, 0.0, rise / np.where(dv == 0, 1.0, dv)))
        self.x = reached[0]
        return reached[1], share

    def _target(self, g: np.ndarray, D: np.ndarray, scale: float) -> np.ndarray:
        """The point to move towards: Newton's, or the scaled gradient's where that descends more."""
        inverse, extra = self._metric(g, D)
        ahead = self._project(self.x - scale * g * inverse, inverse)
        free = ahead > 0
        for _ in range(_FACES):
            y = self.x + self._newton(g, D, free, inverse, extra)
            # Paths that would carry less than nothing leave the face, and the others move again.
            if not np.any(y < 0):
                break
            free &= y > 0
        target = self._project(y, inverse)
        return target if g @ (target - self.x) <= 1e-3 * (g @ (ahead - self.x)) else ahead

    def gradient(self, c: np.ndarray) -> np.ndarray:
        """The costs of all paths above the least one of their pair: a constant a pair changes nothing,
        and without it fewer digits are lost."""
        along = self.matrix @ c
        return along - self._each(np.minimum.reduceat(along, self.starts))

    def _metric(self, g: np.ndarray, D: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(1/m, ε): m, a diagonal that stands for the Hessian, and ε, which is added to it.

        Where costs hardly depend on flows, a pair's whole demand may move: m is at least a share of
        the difference of its costs over its demand. ε vanishes with the excess cost of the pair.
        """
        m = self.matrix @ D
        demand = self.demand
        excess = self._sum(g * self.x) / demand
        least = 1e-3 * np.maximum.reduceat(g, self.starts) / demand
        least = np.maximum(least, 1e-12 * max(float(np.max(m)), float(np.max(g)) / demand.mean()))
        extra = self._each(1e-3 * excess / demand)
        # Where nothing has a cost every point is a solution, and any metric will do.
        m = np.maximum(m, self._each(least)) + extra
        return 1.0 / np.where(m > 0, m, 1.0), extra

    def _newton(
        self, g: np.ndarray, D: np.ndarray, free: np.ndarray, inverse: np.ndarray, extra: np.ndarray
    ) -> np.ndarray:
        """δ with δ = −x off the `free` paths and Σ δ = 0 for every pair, which minimises
        gᵀδ + ½δᵀ(ΔᵀDΔ + ε)δ nearly: conjugate gradients, preconditioned by m on that face."""
        weight = np.where(free, inverse, 0.0)
        share = weight / self._each(self._sum(weight))

        def face(r: np.ndarray) -> np.ndarray:
            return weight * r - share * self._each(self._sum(weight * r))

        def curved(p: np.ndarray) -> np.ndarray:
            return self.matrix @ (D * (self.transposed @ p)) + extra * p

        delta = np.where(free, 0.0, -self.x)
        delta -= share * self._each(self._sum(delta))
        r = g + curved(delta)
        z = face(r)
        p, size = -z, float(r @ z)
        # Emptied paths may have moved flow onto steep links: their residual is no measure.
        goal = _REDUCTION**2 * min(size, float(g @ face(g)))
        for _ in range(_MOST_PRODUCTS):
            if not size > goal:
                break
            Hp = curved(p)
            bend = float(p @ Hp)
            if not bend > 0:
                break
            delta += (size / bend) * p
            r += (size / bend) * Hp
            z = face(r)
            new = float(r @ z)
            p, size = -z + (new / size) * p, new
        return delta

    def _project(self, z: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Each pair's flows on its own simplex: y = (z − τ/m)₊ with the one τ that reaches the demand,
        to which Newton's method climbs in finitely many steps (Michelot 1986)."""
        # With all paths on the face τ is too low. (A shift of z first would lose the digits of pairs
        # with very different m.)
        tau = (self._sum(z) - self.demand) / self._sum(inverse)
        while True:
            y = z - self._each(tau) * inverse
            above = y > 0
            reach = self._sum(np.where(above, z, 0.0)) - self.demand
            higher = reach / self._sum(np.where(above, inverse, 0.0))
            if not np.any(higher > tau):
                y = np.maximum(y, 0.0)
                # Sums that are exact whatever the rounding of τ.
                return y * self._each(self.demand / self._sum(y))
            tau = np.maximum(tau, higher)

    def _sum(self, a: np.ndarray) -> np.ndarray:
        return np.add.reduceat(a, self.starts)

    def _each(self, a: np.ndarray) -> np.ndarray:
        return np.repeat(a, self.sizes)


def _line_search(
    costs: LinkCosts, capacity: np.ndarray, v: np.ndarray, dv: np.ndarray, level: float
) -> float:
    """The α in (0, 1] that minimises Φ(v + α dv), by Newton's method on its slope between bounds."""

    def at(alpha: float) -> np.ndarray:
        return np.maximum(v + alpha * dv, 0.0)

    if costs.costs(at(1.0), capacity) @ dv <= level:
        return 1.0
    low, high, alpha = 0.0, 1.0, 1.0
    for _ in range(40):
        flows = at(alpha)
        slope = float(costs.costs(flows, capacity) @ dv)
        low, high = (low, alpha) if slope > 0 else (alpha, high)
        bend = float(costs.slopes(flows, capacity) @ (dv * dv))
        new = alpha - slope / bend if bend > 0 else low
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - alpha) <= 1e-3 * alpha:
            return new
        alpha = new
    return alpha
