"""Meshes from files: Gmsh, Medit, Abaqus and all other formats of meshio."""

import contextlib
import io
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import Problems, input_error
from .optional import needed

_PLANE = ("triangle", "quad")
_LOWER = ("vertex", "line")
_TAGS = ("gmsh:physical", "medit:ref")
"""Where formats keep the numbers of physical groups."""

_UNREADABLE = (
    SystemExit,  # meshio ends the process where no reader takes the file
    ValueError, LookupError, ArithmeticError, AssertionError, AttributeError, TypeError,
    OSError, EOFError, SyntaxError,
)  # fmt: skip


class Raw(NamedTuple):
    """Nodes, elements of one kind by their corners, and named edges by their ends."""

    points: np.ndarray
    elements: np.ndarray
    kind: str
    edges: dict[str, np.ndarray]


def read_mesh(path: str | os.PathLike[str], contact: str, clamped: str) -> Any:
    """Read the mesh of a file; the boundaries that the file calls `contact` and `clamped` get the names
    "contact" and "clamped".

    Elements are triangles or quadrilaterals with straight sides, all of one kind, in a plane. A
    boundary is a group of line elements: a physical curve of Gmsh by its name, or by its number
    where it has none ("3"), a reference number of Medit, an element set of Abaqus.

    **Raises:** `dvax.InputError` where the file cannot be read, its elements are of another kind, or a
    boundary is missing, empty, inside the body, or not along edges of elements.

    **Returns:** a scikit-fem `MeshTri` or `MeshQuad`.
    """
    place = str(path)
    raw = _plane(_load(Path(path), place), place)
    skfem = needed("skfem")
    used, corners = np.unique(raw.elements, return_inverse=True)
    # Construction points (centres of arcs) belong to no element and would be unknowns without rows.
    new = np.full(len(raw.points), -1)
    new[used] = np.arange(used.size)
    make = skfem.MeshTri if raw.kind == "triangle" else skfem.MeshQuad
    mesh = make(
        np.ascontiguousarray(raw.points[used].T),
        np.ascontiguousarray(corners.reshape(raw.elements.shape).T),
    )
    found: dict[str, np.ndarray] = {}
    wrong = Problems()
    for role, name in (("contact", contact), ("clamped", clamped)):
        with wrong.collect():
            found[role] = _facets(mesh, new, raw.edges, name, role, place)
    wrong.raise_any()
    return mesh.with_boundaries(found)


def _load(path: Path, place: str) -> Any:
    meshio = needed("meshio")
    if not path.is_file():
        raise input_error(place, "no such file", "a mesh is read from a file", "Fix the name")
    said = io.StringIO()
    try:
        # meshio prints to both streams.
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            return meshio.read(path)
    except (meshio.ReadError, *_UNREADABLE) as error:
        reason = " ".join(f"{said.getvalue()} {error}".split())
        raise input_error(
            place, f"what meshio cannot read ({reason[:200]})",
            "the file must be a whole mesh in a format that its ending names",
            "Save it again, as Gmsh 4.1 or 2.2 (.msh), Medit (.mesh), Abaqus (.inp) or VTU",
        ) from error  # fmt: skip


def _plane(mesh: Any, place: str) -> Raw:
    """The elements of the plane and the named edges."""
    kinds = {block.type for block in mesh.cells}
    curved = sorted(
        kind for kind in kinds if kind.startswith(_PLANE) and kind not in _PLANE
    )  # triangle6, quad8, quad9, …
    solid = sorted(
        kind for kind in kinds if not kind.startswith((*_PLANE, *_LOWER))
    )  # tetra, hexahedron, …
    rule = "a body in plane strain is made of triangles or of quadrilaterals with straight sides"
    if solid:
        raise input_error(
            place, f"cells of type {', '.join(solid)}", rule,
            "Mesh a cross-section of the body (Gmsh: mesh in 2-D)",
        )  # fmt: skip
    if curved:
        raise input_error(
            place, f"cells of type {', '.join(curved)}", rule,
            "Save the mesh with elements of order 1 (Gmsh: Mesh.ElementOrder = 1); "
            "displacements are quadratic all the same",
        )  # fmt: skip
    plane = sorted(kinds & set(_PLANE))
    if len(plane) != 1:
        given = "triangles and quadrilaterals" if plane else f"cells of type {sorted(kinds)}"
        raise input_error(
            place, given, f"{rule}, all of one kind",
            "Recombine all of the elements or none (Gmsh: Recombine Surface), and save the surface "
            "as well as its boundary",
        )  # fmt: skip
    elements = np.concatenate([b.data for b in mesh.cells if b.type == plane[0]]).astype(np.int64)
    points = np.asarray(mesh.points, float)
    corners = points[elements.ravel()]
    if not np.isfinite(corners).all():
        raise input_error(
            place, "coordinates that are not finite", "a node has a place", "Export the mesh again"
        )
    if points.shape[1] > 2:
        depth = np.ptp(corners[:, 2])
        if depth > 1e-9 * np.ptp(corners[:, :2], axis=0).max(initial=0.0):
            raise input_error(
                place, f"nodes whose z differs by {depth:g}",
                "a body in plane strain lies in a plane z = const, its punch above it in y",
                "Turn the mesh into that plane",
            )  # fmt: skip
    return Raw(points[:, :2], elements, plane[0], _edges(mesh))


def _edges(mesh: Any) -> dict[str, np.ndarray]:
    """Line elements by the names of their groups."""
    found: dict[str, list[np.ndarray]] = {}
    for i, cells in enumerate(mesh.cells):
        if cells.type != "line":
            continue
        for name, members in mesh.cell_sets.items():
            if not name.startswith("gmsh:") and members[i] is not None and len(members[i]):
                found.setdefault(name, []).append(cells.data[np.asarray(members[i], int)])
        for key in _TAGS:
            if key not in mesh.cell_data:
                continue
            tags = np.asarray(mesh.cell_data[key][i])
            names = {int(tag): name for name, (tag, dim) in mesh.field_data.items() if dim == 1}
            for tag in np.unique(tags):
                name = names.get(int(tag), str(int(tag)))
                found.setdefault(name, []).append(cells.data[tags == tag])
    return {name: np.unique(np.concatenate(parts), axis=0) for name, parts in found.items()}


def _facets(
    mesh: Any, new: np.ndarray, edges: dict[str, np.ndarray], name: str, role: str, place: str
) -> np.ndarray:
    """Return the facets of the mesh that are line elements of a group."""
    if name not in edges:
        there = ", ".join(map(repr, sorted(edges))) or "none"
        raise input_error(
            place, f"no line elements in a group {name!r}; groups of lines are: {there}",
            f"the {role} boundary is named in the file",
            f'Name it (Gmsh: Physical Curve("{name}") = {{…}};, and save again), or say '
            f'{role}="…" with a name that is there',
        )  # fmt: skip
    ends = np.sort(new[edges[name]], axis=1).T
    size = mesh.nvertices + 1
    known = np.sort(mesh.facets, axis=0)
    keys, wanted = known[0] * size + known[1], ends[0] * size + ends[1]
    order = np.argsort(keys)
    at = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), keys.size - 1)]
    lost = int(np.sum((keys[at] != wanted) | (ends[0] < 0)))
    if lost:
        raise input_error(
            place, f"{lost} of {wanted.size} lines of {name!r} that are no edges of elements",
            "a boundary runs along edges of elements",
            "Mesh lines and surface together, so that they share their nodes",
        )  # fmt: skip
    return np.unique(at)
