"""An elastic body, condensed to the normal displacement on its contact boundary."""

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...errors import InputProblem, Problems, input_error
from ...formats.mesh import read_mesh
from ...formats.optional import needed
from .block import block
from .checks import mesh_problems

_GAUSS_POINTS = 5
"""Number of Gauss points on an edge."""

_RANK_TOLERANCE = 1e-12
"""Compliances below this fraction of the largest are roundoff."""


class ElasticBody:
    """A body in plane strain, clamped on one part of its boundary and in contact on another.

    S is the stiffness matrix of quadratic elements, S_ij = ∫ σ(φ_i) : ε(φ_j). N maps a displacement to
    its outward normal component at the Gauss points of the contact boundary, whose weights are W. A
    pressure p there causes the displacement −S⁻¹NᵀWp, and −Cp at the points, with the *compliance
    operator*

        C = N S⁻¹ Nᵀ W = N (N)*,        self-adjoint and ≥ 0 in L²(Γ_C),

    where the adjoint refers to the inner products ⟨v, Sw⟩ of displacements and ⟨p, Wq⟩ of pressures. A
    law on Γ_C depends on a displacement v only through Nv. Displacements caused by pressures lie in
    V₁ = range(S⁻¹NᵀW), which is orthogonal in energy to every v with Nv = 0, so the coupled system can
    be restricted to V₁. With the eigenpairs C e_k = c_k e_k, e_k orthonormal in L²(Γ_C) and c_k > 0,
    the displacements S⁻¹NᵀW e_k/√c_k are an energy-orthonormal basis of V₁. N maps them to √c_k e_k,
    the columns of `trace`.

    **Arguments:**

    - `mesh`: a file that meshio reads; a mapping with the sizes of a block
      (`width`, `height`, `fine_half_width`, `fine`, `coarse`, `layers`, `growth`; the defaults are
      those of the middle reference mesh: 8 × 4, fine for |x| ≤ 0.5, 20 and 9 columns a side, 21
      layers growing by 1.18); None for that mesh; or a scikit-fem `MeshTri` or `MeshQuad` with
      boundaries named "contact" and "clamped";
    - `youngs_modulus` > 0, in [p]; `poisson_ratio` in (−1, 1/2);
    - `contact`, `clamped`: the names of the two boundaries in a file.

    **Raises:** `dvax.InputError` if the mesh cannot be read or is invalid (degenerate, inverted or
    unsupported elements; missing or interior boundaries; parts that are not clamped), and if a modulus
    is out of range. Requires `dvax[fem]`.

    **Attributes:** `points` (q, 2), outward `normals` (q, 2) and `weights` (q,) of Γ_C; `trace` (q, m);
    `compliance` (m,), the c_k in decreasing order; `nodes` (n, 2) of the quadratic elements; `mesh`.
    All are NumPy arrays in double precision, computed once.

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
        # Imported here, so that `import dvax.models` does not load it.
        from scipy.sparse.linalg import splu

        lame = _lame(youngs_modulus, poisson_ratio)
        self.mesh = _mesh(mesh, contact, clamped)
        place = (
            str(mesh) if isinstance(mesh, str | os.PathLike) else "dvax.models.ElasticBody(mesh)"
        )
        Problems(mesh_problems(self.mesh, place)).raise_any()
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
        # S is symmetric positive definite: without pivoting there is half of the fill-in.
        self._solve = splu(
            self._stiffness, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        ).solve  # fmt: skip
        self._assemble_normal(skfem.FacetBasis(
            self.mesh, element, facets=self.mesh.boundaries["contact"],
            intorder=2 * _GAUSS_POINTS - 1,
        ))  # fmt: skip
        _check_normals(self.normals, place)
        self._condense()

    @property
    def top(self) -> float:
        """The height of the highest node of Γ_C."""
        return float(self.mesh.p[1, self.mesh.facets[:, self.mesh.boundaries["contact"]]].max())

    @property
    def unknowns(self) -> int:
        """The number of unknown displacements."""
        return len(self._free)

    def _assemble_normal(self, facets: Any) -> None:
        """Compute N and the points, normals and weights of Γ_C."""
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
        """Compute the eigenpairs of C.

        They are the squared singular values and left singular vectors of W^{1/2}N L, with LLᵀ = S⁻¹ on
        the nodes of Γ_C."""
        contact_nodes = np.unique(self._N.indices[np.abs(self._N.data) > _RANK_TOLERANCE])
        # Solve column by column: with many right-hand sides BLAS uses threads, which took thirty times
        # as long beside other processes.
        columns = []
        for node in contact_nodes:
            unit = np.zeros(self.unknowns)
            unit[node] = 1.0
            columns.append(self._solve(unit)[contact_nodes])
        flexibility = np.stack(columns, axis=1)
        lower = np.linalg.cholesky((flexibility + flexibility.T) / 2)
        root = np.sqrt(self.weights)[:, None]
        left, singular, _ = np.linalg.svd(
            root * (self._N[:, contact_nodes] @ lower), full_matrices=False
        )
        # On a curved boundary N has a null space of tangential displacements.
        positive = singular**2 > _RANK_TOLERANCE * singular[0] ** 2
        self.compliance = singular[positive] ** 2
        self.trace = left[:, positive] * singular[positive] / root

    def displacement_under(self, pressure: Any) -> np.ndarray:
        """Return −S⁻¹NᵀWp, the static displacement, (n, 2), under a pressure at the points."""
        load = self._N.T @ (self.weights * np.asarray(pressure))
        return self._to_nodes(-self._solve(load))

    def displacement(self, coordinates: Any) -> np.ndarray:
        """Return the displacement, (n, 2), with these coordinates in the basis of V₁.

        Among all displacements with the same normal component on Γ_C it has the least elastic
        energy."""
        sources = self.trace @ (np.asarray(coordinates) / self.compliance)
        return -self.displacement_under(sources)

    def stress(self, displacement: Any) -> np.ndarray:
        """Return the element means of σ_xx, σ_yy, σ_zz, σ_xy for a displacement (n, 2)."""
        lame, shear = self._moduli
        gradient = np.asarray(self._basis.interpolate(self._from_nodes(displacement)).grad)
        weights = self._basis.dx / np.sum(self._basis.dx, axis=1, keepdims=True)
        grad = np.sum(gradient * weights, axis=-1)  # the element means of ∂u_i/∂x_j
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
        """Return the areas of the elements."""
        return np.sum(np.asarray(self._basis.dx), axis=1)

    def cells(self) -> np.ndarray:
        """Return the nodes of the elements, (elements, 9 or 6), in the order of VTK.

        These are the corners, the midpoints of the sides in the same order, and the centre of a
        quadrilateral."""
        dofs = self._nodes.element_dofs
        # The order of scikit-fem is that of VTK: the last side of a triangle connects the corners 0
        # and 2, that of a quadrilateral 0 and 3.
        return np.asarray(dofs.T)

    def _to_nodes(self, free: np.ndarray) -> np.ndarray:
        """Return the unknowns as displacements of all nodes, 0 where clamped."""
        whole = np.zeros(self._basis.N)
        whole[self._free] = free
        out = np.zeros((self._nodes.N, 2))
        for i, dofs in enumerate(self._nodes.element_dofs):
            for axis in (0, 1):
                out[dofs, axis] = whole[self._basis.element_dofs[2 * i + axis]]
        return out

    def _from_nodes(self, displacement: Any) -> np.ndarray:
        """Return displacements of all nodes as a vector of scikit-fem's degrees of freedom."""
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
                f"a block has the sizes {', '.join(sizes)}", "Correct the name, or omit it",
            )
            for name in given if name not in sizes
        )  # fmt: skip
        wrong.raise_any()
        return block(**given)
    skfem = needed("skfem")
    if not isinstance(given, skfem.MeshTri | skfem.MeshQuad):
        raise input_error(
            "dvax.models.ElasticBody(mesh)", f"a {type(given).__name__}",
            "a mesh must be a file, the sizes of a block, or a MeshTri or MeshQuad of scikit-fem",
            "Write it to a file with meshio, and pass its name",
        )  # fmt: skip
    return given


def _lame(young: Any, poisson: Any) -> tuple[float, float]:
    wrong = Problems(
        InputProblem(
            f"dvax.models.ElasticBody({name})", repr(value), rule,
            "Use the value of the material; 0.3 for many metals" if name == "poisson_ratio"
            else "Give it in the unit of pressures",
        )
        for name, value, holds, rule in (
            ("youngs_modulus", young, lambda v: 0 < v < math.inf, "it must be a positive number"),
            ("poisson_ratio", poisson, lambda v: -1 < v < 0.5,
             "it must lie between −1 and 1/2, or the elastic energy is not positive definite"),
        )
        if isinstance(value, bool) or not isinstance(value, int | float) or not holds(value)
    )  # fmt: skip
    wrong.raise_any()
    E, nu = float(young), float(poisson)
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


def _check_normals(normals: np.ndarray, place: str) -> None:
    """Raise an `InputError` if an outward normal of the contact boundary does not point up."""
    downward = int(np.sum(normals[:, 1] <= 0))
    if downward:
        raise input_error(
            place, f"{downward} of {len(normals)} points of the contact boundary that face away",
            "the punch comes from above (+y), so outward normals on this boundary must point up",
            "Rotate the mesh, or name the boundary that faces the punch",
        )  # fmt: skip


def _rows(field: Any) -> np.ndarray:
    """Return a field of shape (2, facets, points) as rows (facets · points, 2)."""
    return np.asarray(field).reshape(2, -1).T.copy()
