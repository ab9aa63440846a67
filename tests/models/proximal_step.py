"""One proximal step of a user equilibrium, by Newton's method in as many unknowns as links.

    y = argmin over y ∈ K of ½‖y − x‖² + ρ Φ(Δy)

is y = proj_K(x − ρΔᵀc(v)) with v = Δy, and so a root of r(v) = v − Δ proj_K(x − ρ Δᵀ c(v)), however
many paths there are. The semismooth Newton direction solves

    (I + ρSD) dv = −r,    D = diag c′(v),    S = ΔPΔᵀ,    P ∈ ∂proj_K,

and is one of ascent for the concave dual g(c(v)): dg = ρ⟨Δy − v, D dv⟩ = ρ rᵀD(I + ρSD)⁻¹r ≥ 0. So a
line search on g makes it safe, and nothing is ever divided by c′, which is 0 on an empty link.
"""

from typing import Any

import numpy as np

from dvax.models.traffic.costs import LinkCosts
from dvax.models.traffic.paths import Paths

_MAX_NEWTON_STEPS = 60
"""Newton steps; where they do not do, ρ was too large."""

_PATIENCE = 4
"""Steps near the root that need not halve ‖r‖: then rounding, which ρ multiplies, is all of it."""


class ProximalStep:
    """The step over one set of paths, at one capacity and demand."""

    def __init__(
        self, costs: LinkCosts, capacity: np.ndarray, paths: Paths, demand: np.ndarray
    ) -> None:
        self.costs, self.capacity, self.demand = costs, capacity, demand
        self.incidence = paths.incidence()
        self.transposed = self.incidence.T.tocsr()
        self.starts, self.sizes, self.pairs = paths.starts, paths.sizes, paths.pairs

    def flows(self, x: np.ndarray) -> np.ndarray:
        """v = Δx."""
        return self.transposed @ x

    def solve(
        self, x: np.ndarray, rho: float, tol: float, most: int = _MAX_NEWTON_STEPS
    ) -> tuple[np.ndarray, int]:
        """(y, the Newton steps that it took) to ‖r‖ ≤ tol‖Δy‖, or what rounding allows."""
        v = self.flows(x)
        y, w = self._response(x, rho, v)
        value = self._dual(x, rho, v, y, w)
        least, since = np.inf, 0
        for tries in range(most):
            r = v - w
            size, total = np.linalg.norm(r), np.linalg.norm(w)
            least, since = (size, 0) if size < 0.5 * least else (least, since + 1)
            if size <= tol * total or (since >= _PATIENCE and least < 1e-7 * total):
                return y, tries
            dv, slope = self._newton(rho, v, y, r)
            length = 1.0
            while True:
                trial = np.maximum(v + length * dv, 0.0)
                y, w = self._response(x, rho, trial)
                higher = self._dual(x, rho, trial, y, w)
                # The dual is a difference of large numbers: below its rounding nothing is a descent.
                if higher >= value + 1e-4 * length * slope - 1e-13 * abs(value) or length < 1e-9:
                    break
                length *= 0.5
            v, value = trial, higher
        return y, most

    def _response(self, x: np.ndarray, rho: float, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(proj_K(x − ρΔᵀc(v)), the link flows of that)."""
        along = self.incidence @ self.costs.costs(v, self.capacity)
        # A constant a pair changes no projection, and without it fewer digits are lost.
        along = along - np.repeat(np.minimum.reduceat(along, self.starts), self.sizes)
        y = self._project(x - rho * along)
        return y, self.flows(y)

    def _dual(
        self, x: np.ndarray, rho: float, v: np.ndarray, y: np.ndarray, w: np.ndarray
    ) -> float:
        """½‖y − x‖² + ρ(⟨c, Δy⟩ − Φ*(c)) at c = c(v), where Φ*(c(v)) = ⟨c(v), v⟩ − Φ(v)."""
        c = self.costs.costs(v, self.capacity)
        potential = self.costs.integrals(v, self.capacity).sum()
        return float(0.5 * np.sum((y - x) ** 2) + rho * (c @ (w - v) + potential))

    def _newton(
        self, rho: float, v: np.ndarray, y: np.ndarray, r: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """(dv, the slope of the dual along it), from g = √D dv: (I + ρ√D S √D) g = −√D r."""
        from scipy.linalg import cho_factor, cho_solve
        from scipy.sparse import csr_array

        used = np.flatnonzero(y > 0)
        taken, pairs = self.incidence[used], self.pairs[used]
        count = np.bincount(pairs, minlength=len(self.starts))
        # P is the identity less the mean over the used paths of every pair.
        shape = len(self.starts), len(used)
        mean = csr_array((1.0 / np.sqrt(count[pairs]), (pairs, np.arange(len(used)))), shape=shape)
        means = mean @ taken
        S: Any = (taken.T @ taken - means.T @ means).tocsr()
        slopes = self.costs.slopes(v, self.capacity)
        steep = np.flatnonzero(slopes > 0)
        root = np.sqrt(slopes[steep])
        matrix = rho * root[:, None] * S[steep][:, steep].toarray() * root
        matrix[np.diag_indices(len(steep))] += 1.0
        g = cho_solve(cho_factor(matrix, overwrite_a=True), -root * r[steep])
        spread = np.zeros(len(v))
        spread[steep] = root * g
        return -r - rho * (S @ spread), -rho * float(r @ spread)

    def _project(self, z: np.ndarray) -> np.ndarray:
        """Each pair's flows on its own simplex: y = (z − τ)₊ with the one τ that reaches the demand,
        to which Newton's method climbs in finitely many steps (Michelot 1986)."""
        z = z - np.repeat(np.maximum.reduceat(z, self.starts), self.sizes)
        tau = -self.demand
        while True:
            above = z > np.repeat(tau, self.sizes)
            reach = np.add.reduceat(np.where(above, z, 0.0), self.starts) - self.demand
            higher = reach / np.add.reduceat(above.astype(float), self.starts)
            if not np.any(higher > tau):
                return np.maximum(z - np.repeat(tau, self.sizes), 0.0)
            tau = np.maximum(tau, higher)
