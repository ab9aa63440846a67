"""An elastic body and what a law on its contact boundary sees of it."""

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...errors import InputProblem, Problems, input_error
from ...formats.mesh import read_mesh
from ...formats.optional import needed
from .block import block
from .checks import faults

_POINTS = 5
"""Gauss points on an edge."""

_RANK = 1e-12
"""Compliances below this part of the largest are rounding."""


class ElasticBody:
    """A body in plane strain, held on one part of its boundary and pressed on another.

    S is its stiffness matrix, S_ij = ∫ σ(φ_i) : ε(φ_j), of quadratic elements; N gives the outward
    normal displacement at the Gauss points of the contact boundary, whose weights are W. A pressure
    p there pushes the body by −S⁻¹NᵀWp, and the points by −Cp with the *compliance operator*

        C = N S⁻¹ Nᵀ W = N (N)*,        self-adjoint and ≥ 0 in L²(Γ_C),

    where the adjoint is that of the inner products ⟨v, Sw⟩ of displacements and ⟨p, Wq⟩ of pressures.
    Of a displacement v the points see Nv alone, and whatever is pushed there lies in the space
    V₁ = range(S⁻¹NᵀW), orthogonal in the energy to every v with Nv = 0: a law on Γ_C lives in V₁.
    With the eigenpairs C e_k = c_k e_k, e_k orthonormal in L²(Γ_C) and c_k > 0, the displacements
    S⁻¹NᵀW e_k/√c_k are a basis of V₁, orthonormal in the energy, and N takes them to √c_k e_k: the
    columns of `trace`.

    **Arguments:**

    - `mesh`: a file that meshio reads; a mapping with the sizes of a block
      (`width`, `height`, `fine_half_width`, `fine`, `coarse`, `layers`, `growth`; those left out are
      those of the middle reference mesh: 8 × 4, fine for |x| ≤ 0.5, 20 and 9 columns a side, 21
      layers growing by 1.18); None for that mesh; or a scikit-fem `MeshTri` or `MeshQuad` with
      boundaries of the names "contact" and "clamped";
    - `youngs_modulus` > 0, in [p]; `poisson_ratio` in (−1, 1/2);
    - `contact`, `clamped`: what a file calls the two boundaries.

    **Raises:** `dvax.InputError` for a mesh that cannot be read or is no mesh of a body (elements
    without area, inverted, or of another kind; boundaries missing or inside; parts that nothing
    holds), and for moduli out of range. It needs `dvax[fem]`.

    `points` (q, 2), `normals` (q, 2), outward, and `weights` (q,) of Γ_C; `trace` (q, m);
    `compliance` (m,), the c_k, largest first; `nodes` (n, 2), those of quadratic elements; `mesh`.
    Everything is NumPy, in double precision, computed once.

    ```python
    >>> from dvax.models.fem_contact import ElasticBody
    >>> body = ElasticBody({"fine": 10, "coarse": 4, "layers": 17})
    >>> body.unknowns, body.trace.shape
    (3876, (140, 57))
    >>> print(f"{body.compliance[0]:.4f}")
    3.5570

    ```
    """

    def __init__(
        self,
        mesh: Any = None,
        *,
        youngs_modulus: Any = 1.0,
        poisson_ratio: Any = 0.3,
        contact: str = "contact",
        clamped: str = "clamped",
    ):
        # Not at the top: `import dvax.models` does without.
        from scipy.sparse.linalg import splu

        lame = _lame(youngs_modulus, poisson_ratio)
        self.mesh = _mesh(mesh, contact, clamped)
        place = (
            str(mesh) if isinstance(mesh, str | os.PathLike) else "dvax.models.ElasticBody(mesh)"
        )
        Problems(faults(self.mesh, place)).raise_any()
        self._moduli = lame
        skfem = needed("skfem")
        quads = isinstance(self.mesh, skfem.MeshQuad)
        scalar = skfem.ElementQuad2() if quads else skfem.ElementTriP2()
        element = skfem.ElementVector(scalar)
        self._basis = skfem.Basis(self.mesh, element)
        self._nodes = skfem.Basis(self.mesh, scalar)
        self.nodes = self._nodes.doflocs.T
        self._free = self._basis.complement_dofs(self._basis.get_dofs("clamped"))
        stiffness = needed("skfem.models.elasticity").linear_elasticity(*lame).assemble(self._basis)
        self._stiffness = stiffness[self._free][:, self._free].tocsc()
        # S is symmetric and positive: no pivots, and half of the fill.
        self._solve = splu(
            self._stiffness, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        ).solve  # fmt: skip
        self._normal(skfem.FacetBasis(
            self.mesh, element, facets=self.mesh.boundaries["contact"], intorder=2 * _POINTS - 1
        ))  # fmt: skip
        _facing(self.normals, place)
        self._condense()

    @property
    def top(self) -> float:
        """The height of the highest node of Γ_C."""
        return float(self.mesh.p[1, self.mesh.facets[:, self.mesh.boundaries["contact"]]].max())

    @property
    def unknowns(self) -> int:
        """The number of displacements that are free."""
        return len(self._free)

    def _normal(self, facets: Any) -> None:
        """N, and the points it looks at."""
        from scipy.sparse import coo_array

        self.points = _rows(facets.global_coordinates())
        self.normals = _rows(facets.normals)
        self.weights = np.asarray(facets.dx).ravel()
        q, shape = self.weights.size, facets.dx.shape
        rows = np.arange(q)
        parts = []
        for function, dofs in zip(facets.basis, facets.element_dofs, strict=True):
            value = np.sum(np.asarray(function[0]) * facets.normals, axis=0)
            columns = np.repeat(dofs, shape[1])
            parts.append(coo_array((value.ravel(), (rows, columns)), shape=(q, facets.N)))
        self._N = sum(parts[1:], start=parts[0].tocsr())[:, self._free].tocsr()

    def _condense(self) -> None:
        """The eigenpairs of C, as singular values of W^{1/2}N L with LLᵀ = S⁻¹ on the nodes of Γ_C."""
        touched = np.unique(self._N.indices[np.abs(self._N.data) > _RANK])
        # Column by column: many at once go through threads of BLAS, which beside other processes took
        # thirty times as long.
        columns = []
        for node in touched:
            unit = np.zeros(self.unknowns)
            unit[node] = 1.0
            columns.append(self._solve(unit)[touched])
        flexibility = np.stack(columns, axis=1)
        lower = np.linalg.cholesky((flexibility + flexibility.T) / 2)
        root = np.sqrt(self.weights)[:, None]
        left, singular, _ = np.linalg.svd(root * (self._N[:, touched] @ lower), full_matrices=False)
        # On a curved boundary tangential displacements of its nodes are not seen.
        kept = singular**2 > _RANK * singular[0] ** 2
        self.compliance = singular[kept] ** 2
        self.trace = left[:, kept] * singular[kept] / root

    def pushed(self, pressure: Any) -> np.ndarray:
        """−S⁻¹NᵀWp: the displacement at rest under a pressure at the points, (n, 2)."""
        load = self._N.T @ (self.weights * np.asarray(pressure))
        return self._spread(-self._solve(load))

    def displacement(self, coordinates: Any) -> np.ndarray:
        """The displacement, (n, 2), that has these coordinates in the basis of V₁: of all with this
        normal displacement on Γ_C, the one with the least elastic energy."""
        sources = self.trace @ (np.asarray(coordinates) / self.compliance)
        return -self.pushed(sources)

    def stress(self, displacement: Any) -> np.ndarray:
        """The means over the elements of σ_xx, σ_yy, σ_zz, σ_xy under a displacement (n, 2)."""
        lame, shear = self._moduli
        gradient = np.asarray(self._basis.interpolate(self._gather(displacement)).grad)
        weights = self._basis.dx / np.sum(self._basis.dx, axis=1, keepdims=True)
        grad = np.sum(gradient * weights, axis=-1)  # ∂u_i/∂x_j, a mean of each element
        volume = lame * (grad[0, 0] + grad[1, 1])
        return np.stack(
            [
                volume + 2 * shear * grad[0, 0],
                volume + 2 * shear * grad[1, 1],
                volume,
                shear * (grad[0, 1] + grad[1, 0]),
            ],
            axis=1,
        )

    def areas(self) -> np.ndarray:
        """Those of the elements."""
        return np.sum(np.asarray(self._basis.dx), axis=1)

    def cells(self) -> np.ndarray:
        """Nodes of the elements, (elements, 9 or 6): corners, then the middles of the sides in the same
        order around (the order of VTK), then the middle of a quadrilateral."""
        dofs = self._nodes.element_dofs
        # scikit-fem sorts the corners of a triangle: its last side runs from corner 0 to corner 2, and
        # so does that of a quadrilateral from 0 to 3, which is the order of VTK already.
        return np.asarray(dofs.T)

    def _spread(self, free: np.ndarray) -> np.ndarray:
        """Unknowns as a displacement of every node, 0 where clamped."""
        whole = np.zeros(self._basis.N)
        whole[self._free] = free
        out = np.zeros((self._nodes.N, 2))
        for i, dofs in enumerate(self._nodes.element_dofs):
            for axis in (0, 1):
                out[dofs, axis] = whole[self._basis.element_dofs[2 * i + axis]]
        return out

    def _gather(self, displacement: Any) -> np.ndarray:
        """The inverse of `_spread`, all unknowns."""
        given, whole = np.asarray(displacement), np.zeros(self._basis.N)
        for i, dofs in enumerate(self._nodes.element_dofs):
            for axis in (0, 1):
                whole[self._basis.element_dofs[2 * i + axis]] = given[dofs, axis]
        return whole


def _mesh(given: Any, contact: str, clamped: str) -> Any:
    if given is None:
        return block()
    if isinstance(given, str | os.PathLike):
        return read_mesh(given, contact, clamped)
    if isinstance(given, Mapping):
        sizes = ("width", "height", "fine_half_width", "fine", "coarse", "layers", "growth")
        wrong = Problems(
            InputProblem(
                "dvax.models.ElasticBody(mesh)", f"a size {name!r}",
                f"a block has the sizes {', '.join(sizes)}", "Fix the name, or leave it out",
            )
            for name in given if name not in sizes
        )  # fmt: skip
        wrong.raise_any()
        return block(**given)
    skfem = needed("skfem")
    if not isinstance(given, skfem.MeshTri | skfem.MeshQuad):
        raise input_error(
            "dvax.models.ElasticBody(mesh)", f"a {type(given).__name__}",
            "a mesh is a file, the sizes of a block, or a MeshTri or MeshQuad of scikit-fem",
            "Write it to a file with meshio, and give its name",
        )  # fmt: skip
    return given


def _lame(young: Any, poisson: Any) -> tuple[float, float]:
    wrong = Problems(
        InputProblem(
            f"dvax.models.ElasticBody({name})", repr(value), rule,
            "Look it up for the material; 0.3 for many metals" if name == "poisson_ratio"
            else "Give it in the unit of pressures",
        )
        for name, value, holds, rule in (
            ("youngs_modulus", young, lambda v: 0 < v < math.inf, "it must be a positive number"),
            ("poisson_ratio", poisson, lambda v: -1 < v < 0.5,
             "it must lie between −1 and 1/2, or the elastic energy is no norm"),
        )
        if isinstance(value, bool) or not isinstance(value, int | float) or not holds(value)
    )  # fmt: skip
    wrong.raise_any()
    E, nu = float(young), float(poisson)
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


def _facing(normals: np.ndarray, place: str) -> None:
    away = int(np.sum(normals[:, 1] <= 0))
    if away:
        raise input_error(
            place, f"{away} of {len(normals)} points of the contact boundary that face away",
            "the punch comes from above (+y), so outward normals on this boundary point up",
            "Turn the mesh, or name the boundary that faces the punch",
        )  # fmt: skip


def _rows(field: Any) -> np.ndarray:
    """A field 2 × facets × points as rows."""
    return np.asarray(field).reshape(2, -1).T.copy()
