"""A plain finite-element penalty loop, as it is written by hand today: implicit Euler in time, Newton's
method on the penalty in every step, on all displacements of the body. It knows scikit-fem and SciPy
alone.

    (τ/Δt)(Kxⁿ⁺¹ − Kxⁿ) + Kxⁿ⁺¹ + NᵀW p(Nxⁿ⁺¹ − g(tⁿ⁺¹)) = 0,    p(z) = min(max(βz, 0), κ₀)
"""

from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import skfem
from skfem.models.elasticity import linear_elasticity


class Run(NamedTuple):
    """Forces at the end of every step, the last pressure at the contact points, and Newton's steps."""

    ts: np.ndarray
    forces: np.ndarray
    pressure: np.ndarray
    iterations: int


class PenaltyLoop:
    """A block of Kelvin–Voigt material under a rigid parabolic punch.

    `mesh` is a scikit-fem MeshQuad whose top is y = 0 and is named "contact", and whose held side is
    named "clamped". `factor`: "once" factorises K alone, and the contact enters Newton's matrix by the
    Woodbury formula; "each" factorises Newton's matrix again in every iteration, which is the least
    to write.
    """

    def __init__(
        self, mesh: Any, *, beta: float, cap: float, depth: float = 0.01, radius: float = 10.0,
        tau: float = 1.0, ramp: float = 2.0, young: float = 1.0, poisson: float = 0.3,
        factor: str = "once",
    ):  # fmt: skip
        self.beta, self.cap, self.depth, self.tau, self.ramp = beta, cap, depth, tau, ramp
        self.factor = factor
        element = skfem.ElementVector(skfem.ElementQuad2())
        basis = skfem.Basis(mesh, element)
        lame = young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))
        free = basis.complement_dofs(basis.get_dofs("clamped"))
        self.K = linear_elasticity(*lame).assemble(basis)[free][:, free].tocsc()
        edge = skfem.FacetBasis(mesh, element, facets=mesh.boundaries["contact"], intorder=9)
        self.w = edge.dx.ravel()
        self.gap = edge.global_coordinates()[0].ravel() ** 2 / (2 * radius)
        rows = np.arange(self.w.size)
        normal: Any = sum(
            scipy.sparse.coo_array(
                (np.ravel(np.asarray(f[0])[1]), (rows, np.repeat(dofs, edge.dx.shape[1]))),
                shape=(rows.size, edge.N),
            ).tocsr()
            for f, dofs in zip(edge.basis, edge.element_dofs)
        )
        self.N = normal[:, free].tocsr()
        self.N.eliminate_zeros()
        if factor == "once":
            self.touched = np.unique(self.N.indices)
            self.lu = _factorised(self.K)
            columns = []
            for node in self.touched:
                unit = np.zeros(self.K.shape[0])
                unit[node] = 1.0
                columns.append(self.lu.solve(unit))
            self.influence = np.stack(columns, axis=1)
            self.local = self.N[:, self.touched].toarray()

    def run(self, dt: float, end: float, tol: float = 1e-12) -> Run:
        """`end`/`dt` equal steps from rest."""
        steps = round(end / dt)
        a = self.tau / dt
        x = np.zeros(self.K.shape[0])
        ts, forces, total, p = [], [], 0, np.zeros_like(self.w)
        for k in range(1, steps + 1):
            t = k * dt
            g = self.gap - self.depth * min(t / self.ramp, 1.0)
            old = a * (self.K @ x)
            p, residual = self._residual(x, old, a, g)
            size = np.linalg.norm(residual)
            aim = tol * max(np.linalg.norm(old), self.beta * self.depth * self.w.min())
            for _ in range(50):
                if size <= aim:
                    break
                z = self.beta * (self.N @ x - g)
                move = self._solve(residual, a, (z > 0) & (z < self.cap))
                total += 1
                for part in (1.0, 0.5, 0.25, 0.125, 0.0625):  # Newton alone may cycle at the cap
                    p_new, r_new = self._residual(x - part * move, old, a, g)
                    if np.linalg.norm(r_new) < size:
                        break
                x = x - part * move
                p, residual, size = p_new, r_new, np.linalg.norm(r_new)
            else:
                raise RuntimeError(f"Newton's method has not converged at t = {t:g}")
            ts.append(t)
            forces.append(float(self.w @ p))
        return Run(np.array(ts), np.array(forces), p, total)

    def _residual(self, x: Any, old: Any, a: float, g: Any) -> tuple[Any, Any]:
        p = np.clip(self.beta * (self.N @ x - g), 0.0, self.cap)
        return p, (a + 1.0) * (self.K @ x) - old + self.N.T @ (self.w * p)

    def _solve(self, r: Any, a: float, active: Any) -> Any:
        scale = self.w * self.beta * active
        if self.factor == "each":
            added = self.N.T @ scipy.sparse.diags_array(scale) @ self.N
            return _factorised(((a + 1.0) * self.K + added).tocsc()).solve(r)
        # ((a+1)K + BᵀMB)⁻¹r = y − K⁻¹Bᵀ((a+1)I + MG)⁻¹M By,  y = K⁻¹r/(a+1),  G = BK⁻¹Bᵀ.
        y = self.lu.solve(r) / (a + 1.0)
        M = (self.local.T * scale) @ self.local
        G = self.influence[self.touched]
        small = (a + 1.0) * np.eye(len(M)) + M @ G
        return y - self.influence @ np.linalg.solve(small, M @ y[self.touched])


def _factorised(matrix: Any) -> Any:
    return scipy.sparse.linalg.splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
