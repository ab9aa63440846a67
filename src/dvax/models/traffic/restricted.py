"""Beckmann's problem over given paths, by block Gauss–Seidel with projected Newton steps.

    min Φ(Δx) over x ≥ 0 whose paths add up to the demand of every pair.

A Newton step for all pairs at once overshoots: thousands of pairs share two alternatives, and each
would move all of its flow. So the pairs are divided into blocks, and the step of a block starts from
the link flows after the previous block (Gauss–Seidel). Within a block the Hessian couples the pairs.
The conjugate gradient method minimises the quadratic model of Φ on the face of the paths that carry
flow after a scaled projected gradient step (Bertsekas 1982), and on smaller faces while flows would be
negative. Every step ends with an exact line search. `ROUGH` steps suffice until slopes differ by many
orders of magnitude; then `EXACT` ones minimise the model from face to face.

Only pairs with at least two paths are unknowns, and only links that are not on all paths of a pair
affect its choice; the other flows are constants.
"""

import itertools
from typing import Any, NamedTuple

import numpy as np

from .costs import LinkCosts
from .paths import Paths

_BLOCK_ENTRIES = 50_000
_MAX_BLOCKS = 32
"""Target number of matrix entries in a block, and largest number of blocks. In smaller blocks NumPy's
overhead of 1 ms a step dominates. With 32 blocks Chicago's sketch network needs a third of the sweeps
that it needs with one block."""

_PREDICTION_SCALES = 0.5, 0.05, 0.005
"""Lengths of the scaled gradient step that predicts which paths carry flow. A full step overshoots for
pairs that share links: with one half, Chicago's sketch network needs two thirds of the steps."""

_SHORT_STEP = 0.25
"""A step with a smaller step length is computed again, with a shorter prediction and larger slopes."""


class Effort(NamedTuple):
    """Largest number of nested `faces` in a step; whether the model of Φ falls from face to face
    (`monotone`); relative residual of the conjugate gradient method (`tolerance`), and its largest
    number of `products` with the Hessian."""

    faces: int
    monotone: bool
    tolerance: float
    products: int


ROUGH = Effort(5, False, 0.1, 200)
EXACT = Effort(50, True, 1e-8, 5000)
"""Where slopes differ by many orders of magnitude, only the exact Newton step moves the pairs that are
coupled by small ones."""

_SLOPE_ROUNDOFF = 1e-15
"""A slope of Φ below this fraction of the total cost is treated as zero. Moving flow between paths with
the same links changes Φ only by roundoff, which must not shorten a step that empties paths."""

_TINY = 1e-9
"""Part of a pair's demand below which the flow of a path is emptied at once."""


class RestrictedProblem:
    """Beckmann's problem over `paths`, with the initial flows `x`.

    `flows()` returns the current flows. `shortest_step` is the smallest step length of all line
    searches.
    """

    def __init__(
        self, costs: LinkCosts, capacity: np.ndarray, paths: Paths, demand: np.ndarray,
        x: np.ndarray, blocks: int | None = None, effort: Effort = ROUGH,
    ) -> None:  # fmt: skip
        self.costs, self.capacity, self.start = costs, capacity, x
        rows = paths.differences(demand)
        self.rows, chosen = rows.rows, demand[rows.pairs]
        starts = np.append(np.cumsum(rows.sizes) - rows.sizes, len(rows.rows))
        ends = rows.ends[starts]
        if blocks is None:
            blocks = int(np.clip(ends[-1] // _BLOCK_ENTRIES, 1, _MAX_BLOCKS))
        blocks = max(1, min(blocks, len(rows.sizes)))
        cuts = np.searchsorted(ends, np.linspace(0, ends[-1], blocks + 1))
        cuts[0], cuts[-1] = 0, len(rows.sizes)
        self.blocks = [
            _Block(
                rows.matrix(int(starts[a]), int(starts[b])), rows.sizes[a:b], chosen[a:b],
                x[rows.rows[starts[a] : starts[b]]], effort,
            )
            for a, b in itertools.pairwise(cuts.tolist())
            if b > a
        ]  # fmt: skip
        self.shortest_step = 1.0
        self.v = sum((block.transposed @ block.x for block in self.blocks), rows.fixed)

    def sweep(self) -> None:
        """Take a step for every block."""
        for block in self.blocks:
            self.v, length = block.step(self.costs, self.capacity, self.v)
            self.shortest_step = min(self.shortest_step, length)

    def excess(self) -> float:
        """Return the total cost minus that on the shortest ones of the given paths."""
        c = self.costs.costs(self.v, self.capacity)
        return float(sum(block.x @ block.gradient(c) for block in self.blocks))

    def flows(self) -> np.ndarray:
        """Return x on all paths."""
        x = self.start.copy()
        if self.blocks:
            x[self.rows] = np.concatenate([block.x for block in self.blocks])
        return x


class _Model(NamedTuple):
    """gᵀδ + ½δᵀ(ΔᵀDΔ + ε)δ, with the `inverse` of a diagonal metric and the `regularisation` ε."""

    g: np.ndarray
    D: np.ndarray
    inverse: np.ndarray
    regularisation: np.ndarray


class _Block:
    """A block of pairs: `matrix` has one row a path, `sizes` are the numbers of paths of the pairs."""

    def __init__(
        self, matrix: Any, sizes: np.ndarray, demand: np.ndarray, x: np.ndarray, effort: Effort
    ) -> None:
        self.matrix, self.transposed, self.effort = matrix, matrix.T, effort
        self.sizes, self.demand, self.x = sizes, demand, x
        self.starts = np.cumsum(sizes) - sizes

    def step(
        self, costs: LinkCosts, capacity: np.ndarray, v: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Update x; return (the link flows v of all trips after the step, the step length)."""
        c, D = costs.costs(v, capacity), costs.slopes(v, capacity)
        g = self.gradient(c)
        best, result, best_length = 0.0, (self.x, v), 1.0
        for scale in _PREDICTION_SCALES:
            target = self._target(g, D, scale)
            dx = target - self.x
            descent = -float(g @ dx)
            if not descent > 0:
                break
            dv = self.transposed @ dx
            length = _line_search(costs, capacity, v, dv, _SLOPE_ROUNDOFF * float(c @ v))
            if length * descent > best:
                x = target if length == 1.0 else np.maximum(self.x + length * dx, 0.0)
                best, best_length = length * descent, length
                result = x, np.maximum(v + length * dv, 0.0)
            if length >= _SHORT_STEP:
                break
            # Replace the slopes at v (0 on an empty link) by the mean slopes along the step.
            rise = costs.costs(np.maximum(v + dv, 0.0), capacity) - c
            D = np.maximum(D, np.where(dv == 0, 0.0, rise / np.where(dv == 0, 1.0, dv)))
        self.x = result[0]
        return result[1], best_length

    def _target(self, g: np.ndarray, D: np.ndarray, scale: float) -> np.ndarray:
        """Return the Newton point, or the scaled gradient point if its predicted descent is larger."""
        inverse, regularisation = self._metric(g, D)
        model = _Model(g, D, inverse, regularisation)
        predicted = self._project(self.x - scale * g * inverse, inverse)
        free = predicted > 0
        if self.effort.monotone:
            free |= self.x > _TINY * self._to_paths(self.demand)
            y = self._model_minimum(model, free)
        else:
            for _ in range(self.effort.faces):
                y = self.x + self._newton(model, free)
                # Remove paths with negative flow from the face, and repeat; roundoff of a long step
                # may leave none of a pair.
                free = free & (y > 0)
                if not np.any(y < 0) or np.any(self._sum(free) == 0):
                    break
        target = self._project(y, inverse)
        newton_descends = g @ (target - self.x) <= 1e-3 * (g @ (predicted - self.x))
        return target if newton_descends else predicted

    def _model_minimum(self, model: _Model, free: np.ndarray) -> np.ndarray:
        """Return the minimum of the model on the face of the `free` paths, or on a smaller face.

        The way to the minimum of a face ends where the first path is empty. From there it goes to the
        minimum without that path. So the model falls all along."""
        y = self.x
        for _ in range(self.effort.faces):
            goal = self.x + self._newton(model, free)
            falls = free & (goal < 0)
            if not np.any(falls):
                return goal
            ratios = np.where(falls, y / np.where(falls, y - goal, 1.0), 1.0)
            length = float(np.min(ratios))
            free = free & (ratios > length)
            y = np.where(free, np.maximum(y + length * (goal - y), 0.0), 0.0)
        return y

    def gradient(self, c: np.ndarray) -> np.ndarray:
        """Return the path costs minus the least cost of each pair.

        A constant for each pair does not change the problem; subtracting it reduces cancellation."""
        path_costs = self.matrix @ c
        return path_costs - self._to_paths(np.minimum.reduceat(path_costs, self.starts))

    def _metric(self, g: np.ndarray, D: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (1/m, ε): a diagonal approximation m of the Hessian, and a regularisation ε.

        If costs hardly depend on flows, the whole demand of a pair may move. So m is at least a
        fraction of the cost difference of the pair over its demand. ε tends to 0 with the excess
        cost of the pair."""
        m = self.matrix @ D
        demand = self.demand
        excess = self._sum(g * self.x) / demand
        least = 1e-3 * np.maximum.reduceat(g, self.starts) / demand
        least = np.maximum(least, 1e-12 * max(float(np.max(m)), float(np.max(g)) / demand.mean()))
        regularisation = self._to_paths(1e-3 * excess / demand)
        # If all costs are zero, every point is a solution, and the metric is arbitrary.
        m = np.maximum(m, self._to_paths(least)) + regularisation
        return 1.0 / np.where(m > 0, m, 1.0), regularisation

    def _newton(self, model: _Model, free: np.ndarray) -> np.ndarray:
        """Return the Newton step δ on the face of the `free` paths.

        δ = −x on the other paths and Σ δ = 0 for every pair. It minimises gᵀδ + ½δᵀ(ΔᵀDΔ + ε)δ
        approximately, by conjugate gradients with the preconditioner m on this face."""
        g, D, inverse, regularisation = model
        weight = np.where(free, inverse, 0.0)
        fraction = weight / self._to_paths(self._sum(weight))

        def precondition(r: np.ndarray) -> np.ndarray:
            return weight * r - fraction * self._to_paths(self._sum(weight * r))

        def hessian_product(p: np.ndarray) -> np.ndarray:
            return self.matrix @ (D * (self.transposed @ p)) + regularisation * p

        delta = np.where(free, 0.0, -self.x)
        delta -= fraction * self._to_paths(self._sum(delta))
        r = g + hessian_product(delta)
        z = precondition(r)
        p, size = -z, float(r @ z)
        # Emptied paths may have moved flow onto steep links, so their residual sets no tolerance.
        goal = self.effort.tolerance**2 * min(size, float(g @ precondition(g)))
        for _ in range(self.effort.products):
            if not size > goal:
                break
            Hp = hessian_product(p)
            curvature = float(p @ Hp)
            if not curvature > 0:
                break
            delta += (size / curvature) * p
            r += (size / curvature) * Hp
            z = precondition(r)
            new = float(r @ z)
            p, size = -z + (new / size) * p, new
        return delta

    def _project(self, z: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Project the flows of each pair onto its simplex: y = (z − τ/m)₊.

        Newton's method determines τ from the demand, monotonically and in finitely many steps (Michelot
        1986)."""
        # The τ with all paths positive is a lower bound. (Shifting z first would cause cancellation for
        # pairs with very different m.)
        tau = (self._sum(z) - self.demand) / self._sum(inverse)
        while True:
            y = z - self._to_paths(tau) * inverse
            positive = y > 0
            surplus = self._sum(np.where(positive, z, 0.0)) - self.demand
            new_tau = surplus / self._sum(np.where(positive, inverse, 0.0))
            if not np.any(new_tau > tau):
                y = np.maximum(y, 0.0)
                # Scale, so that the sums are exact despite the roundoff in τ.
                return y * self._to_paths(self.demand / self._sum(y))
            tau = np.maximum(tau, new_tau)

    def _sum(self, a: np.ndarray) -> np.ndarray:
        """Return the sums over the paths of each pair."""
        return np.add.reduceat(a, self.starts)

    def _to_paths(self, a: np.ndarray) -> np.ndarray:
        """Return, for every path, the number of its pair."""
        return np.repeat(a, self.sizes)


def _line_search(
    costs: LinkCosts, capacity: np.ndarray, v: np.ndarray, dv: np.ndarray, slope_tolerance: float
) -> float:
    """Return the α in (0, 1] that minimises Φ(v + α dv), by a safeguarded Newton method."""

    def at(alpha: float) -> np.ndarray:
        return np.maximum(v + alpha * dv, 0.0)

    if costs.costs(at(1.0), capacity) @ dv <= slope_tolerance:
        return 1.0
    low, high, alpha = 0.0, 1.0, 1.0
    for _ in range(40):
        flows = at(alpha)
        slope = float(costs.costs(flows, capacity) @ dv)
        low, high = (low, alpha) if slope > 0 else (alpha, high)
        curvature = float(costs.slopes(flows, capacity) @ (dv * dv))
        new = alpha - slope / curvature if curvature > 0 else low
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - alpha) <= 1e-3 * alpha:
            return new
        alpha = new
    return alpha
