"""Meshes from files of Gmsh, Medit and Abaqus, and VTU.

meshio reads more formats, among them several whose files name other files. A mesh is one file here, so
that a configuration reads no file that it does not name, and the copy in a run directory is complete.
"""

import contextlib
import io
import os
import re
import struct
import warnings
import xml.etree.ElementTree as ElementTree
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError, Problems, input_error
from .optional import needed
from .table import read_bytes

_CORNERS = {"triangle": 3, "quad": 4}
_PLANE = tuple(_CORNERS)
_LOWER = ("vertex", "line")
_TAGS = ("gmsh:physical", "medit:ref")
"""Where formats keep the numbers of physical groups."""

_UNREADABLE = (
    SystemExit,  # meshio ends the process where no reader takes the file
    ValueError, LookupError, ArithmeticError, AssertionError, AttributeError, TypeError,
    OSError, EOFError, SyntaxError, NameError, MemoryError, RuntimeError, Warning, struct.error,
    zlib.error,
)  # fmt: skip
_FORMATS = {".msh": "gmsh", ".mesh": "medit", ".inp": "abaqus", ".vtu": "vtu"}
_FARTHEST = 1e100
_LARGE_INTEGER = re.compile(rb"(?<![\w.])\d{8,}(?![\w.])")
"""Numbers of nodes and elements that no mesh has: meshio allocates arrays of this size."""
_MAX_COMPRESSED = 2**17
"""Bytes of a compressed file: zlib expands them up to a thousandfold."""


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

    **Raises:** `dvax.InputError` where the file cannot be read, is of another format than Gmsh (.msh),
    Medit (.mesh), Abaqus (.inp) and VTU, or includes another file; where its elements are of another
    kind, or a boundary is missing, empty, inside the body, or not along edges of elements.

    **Returns:** a scikit-fem `MeshTri` or `MeshQuad`.

    ```python
    >>> import pathlib, tempfile
    >>> from dvax.formats import read_mesh
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "square.mesh"
    >>> _ = file.write_text('''MeshVersionFormatted 2
    ... Dimension 2
    ... Vertices
    ... 4
    ... 0 0 0
    ... 1 0 0
    ... 1 1 0
    ... 0 1 0
    ... Edges
    ... 4
    ... 1 2 1
    ... 2 3 2
    ... 3 4 3
    ... 4 1 2
    ... Triangles
    ... 2
    ... 1 2 3 0
    ... 1 3 4 0
    ... End
    ... ''')
    >>> mesh = read_mesh(file, contact="3", clamped="1")
    >>> mesh.nelements, sorted(mesh.boundaries)
    (2, ['clamped', 'contact'])

    ```
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
    kind = _FORMATS.get(path.suffix.lower())
    if kind is None:
        raise input_error(
            place, f"a file of the kind {path.suffix[:20]!r}",
            f"a mesh is one file that meshio can read, {', '.join(_FORMATS)}",
            "Convert it: meshio convert FROM TO.msh --output-format gmsh22 --ascii",
        )  # fmt: skip
    said = io.StringIO()
    try:
        # meshio prints to both streams.
        with (
            contextlib.redirect_stdout(said),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(),
        ):
            _check_content(read_bytes(path, "a mesh"), kind, place)
            warnings.simplefilter("error", RuntimeWarning)
            warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
            return meshio.read(path, kind)
    except InputError:
        raise  # it is a ValueError too
    except (meshio.ReadError, *_UNREADABLE) as error:
        reason = " ".join(f"{said.getvalue()} {error}".split())
        raise input_error(
            place, f"what meshio cannot read ({reason[:200]})",
            "the file must be a whole mesh in a format that its ending names",
            "Save it again, as Gmsh 4.1 or 2.2 (.msh), Medit (.mesh), Abaqus (.inp) or VTU",
        ) from error  # fmt: skip


def _check_content(content: bytes, kind: str, place: str) -> None:
    """Raise an `InputError` for what makes meshio read another file, or allocate far more memory than
    the file has bytes."""
    large, wrong = None, Problems()
    if kind != "vtu":
        large = _LARGE_INTEGER.search(content)
    header = re.match(rb"\s*\$MeshFormat\s+([234])\S*\s+([01])\s", content)
    if kind == "gmsh" and header is not None and header[1] == b"2" and header[2] == b"0":
        # Numbers of nodes are read as floats in this version, so that 1e9 is one.
        nodes = re.search(rb"\$Nodes\s+\d+\s(.*?)\$EndNodes", content, re.DOTALL)
        tags = [] if nodes is None else nodes[1].split()[::4]
        large = large or next((m for m in map(_NOT_TAG.match, tags) if m), None)
    if large is not None:
        wrong.add(
            place, large[0][:30].decode("latin-1"),
            "numbers of nodes and elements have at most 7 digits", "Number them from 1",
        )  # fmt: skip
    if kind == "gmsh" and header is not None and header[1] != b"2" and header[2] == b"1":
        wrong.add(
            place, "a binary file of Gmsh 4", "the numbers of its nodes cannot be checked",
            "Save it as text (Gmsh: Mesh.Binary = 0), or as Gmsh 2.2",
        )  # fmt: skip
    if kind == "abaqus" and re.search(
        rb"^\s*\*+\s*INCLUDE\b", content, re.MULTILINE | re.IGNORECASE
    ):
        wrong.add(
            place, "*INCLUDE", "a mesh is one file, and includes no other one",
            "Put the content of that file in its place",
        )  # fmt: skip
    if kind == "vtu":
        _, root = next(ElementTree.iterparse(io.BytesIO(content), events=("start",)))
        compressor = root.get("compressor")
        if compressor and (compressor != _ZLIB or len(content) > _MAX_COMPRESSED):
            wrong.add(
                place, f"a file of {len(content)} bytes, compressed by {compressor[:40]}",
                f"compressed files are of zlib and have at most {_MAX_COMPRESSED} bytes, since they "
                "expand a thousandfold", "Save it without compression",
            )  # fmt: skip
    wrong.raise_any()


_ZLIB = "vtkZLibDataCompressor"
_NOT_TAG = re.compile(rb"(?!\d{1,7}$).*", re.DOTALL)


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
    points = np.asarray(mesh.points, float)
    corners_of = {plane[0]: _CORNERS[plane[0]], "line": 2}
    for block in mesh.cells:
        if block.type in corners_of:
            _check_cells(np.asarray(block.data), corners_of[block.type], points, place)
    elements = np.concatenate([b.data for b in mesh.cells if b.type == plane[0]]).astype(np.int64)
    corners = points[elements.ravel()]
    if not (np.abs(corners) <= _FARTHEST).all():
        raise input_error(
            place, "coordinates that are not finite, or too large", f"they are at most {_FARTHEST:g}, "
            "or areas overflow", "Export the mesh again, in a larger unit of length",
        )  # fmt: skip
    if points.shape[1] > 2:
        depth = np.ptp(corners[:, 2])
        if depth > 1e-9 * np.ptp(corners[:, :2], axis=0).max(initial=0.0):
            raise input_error(
                place, f"nodes whose z differs by {depth:g}",
                "a body in plane strain lies in a plane z = const, its punch above it in y",
                "Turn the mesh into that plane",
            )  # fmt: skip
    return Raw(points[:, :2], elements, plane[0], _edges(mesh, place))


def _check_cells(cells: np.ndarray, corners: int, points: np.ndarray, place: str) -> None:
    """Raise an `InputError` unless every cell has this number of `corners`, all of them among the
    points: meshio does not check it."""
    if points.ndim != 2 or points.shape[1] < 2:
        given, rule = f"points of shape {points.shape}", "a point has two or three coordinates"
    elif cells.ndim != 2 or cells.shape[1] != corners or not cells.size:
        given, rule = f"elements of shape {cells.shape}", f"each of them has {corners} nodes"
    elif cells.min() < 0 or cells.max() >= len(points):
        wrong = cells[(cells < 0) | (cells >= len(points))]
        given, rule = (
            f"node {wrong[0] + 1} of an element",
            f"there are the nodes 1 to {len(points)}",
        )
    else:
        return
    raise input_error(place, given, rule, "Export the mesh again; the file may be incomplete")


def _edges(mesh: Any, place: str) -> dict[str, np.ndarray]:
    """Line elements by the names of their groups. Raises `InputError` where a group has elements that
    are not there."""
    try:
        return _grouped(mesh)
    except (IndexError, ValueError, TypeError) as error:
        raise input_error(
            place, f"groups of lines that do not fit its elements ({error})"[:200],
            "a group has elements of the file", "Export the mesh again; the file may be incomplete",
        ) from error  # fmt: skip


def _grouped(mesh: Any) -> dict[str, np.ndarray]:
    found: dict[str, list[np.ndarray]] = {}
    for i, cells in enumerate(mesh.cells):
        if cells.type != "line":
            continue
        for name, members in mesh.cell_sets.items():
            if str(name).startswith("gmsh:") or members[i] is None:
                continue
            if len(members[i]):
                found.setdefault(str(name), []).append(cells.data[np.asarray(members[i], int)])
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
