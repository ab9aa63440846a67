"""Files with the fields of a body, for ParaView."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import input_error
from ...formats.optional import needed
from .body import ElasticBody

_EXTENSIONS = (".vtu", ".vtk")


def write(
    body: ElasticBody,
    path: Path,
    displacement: np.ndarray,
    stress: np.ndarray,
    contact: Mapping[str, np.ndarray],
) -> tuple[Path, Path]:
    """Write the fields of the body and those of its contact points; return the two paths.

    The first file has the elements with the displacements of their nodes and the element means of the
    stress and the von Mises stress. The second, NAME-contact, has the contact points with the fields
    of `contact`.

    **Raises:** `dvax.InputError` if the extension is not .vtu or .vtk, or the folder does not exist.
    """
    if path.suffix not in _EXTENSIONS or not path.parent.is_dir():
        raise input_error(
            "dvax.models.FemContact.write(path)", repr(str(path)),
            f"it must be a file name with the extension {' or '.join(_EXTENSIONS)} in an existing "
            "folder",
            "Create the folder, or correct the name",
        )  # fmt: skip
    meshio = needed("meshio")
    cells = body.cells()
    kind = "quad9" if cells.shape[1] == 9 else "triangle6"
    meshio.Mesh(
        _in_space(body.nodes),
        [(kind, cells)],
        point_data={"displacement": _in_space(displacement)},
        cell_data={"stress": [_tensor(stress)], "von_mises": [von_mises(stress)]},
    ).write(path)
    contact_path = path.with_name(f"{path.stem}-contact{path.suffix}")
    points = np.arange(len(body.points))[:, None]
    meshio.Mesh(_in_space(body.points), [("vertex", points)], point_data=dict(contact)).write(
        contact_path
    )
    return path, contact_path


def von_mises(stress: Any) -> np.ndarray:
    """Return √(½((σ_xx−σ_yy)² + (σ_yy−σ_zz)² + (σ_zz−σ_xx)²) + 3σ_xy²)."""
    xx, yy, zz, xy = np.asarray(stress).T
    return np.sqrt(0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) + 3 * xy**2)


def _in_space(vectors: np.ndarray) -> np.ndarray:
    """Return plane vectors with a third component 0."""
    return np.column_stack([vectors, np.zeros(len(vectors))])


def _tensor(stress: np.ndarray) -> np.ndarray:
    """Return the nine entries of the tensor, row by row, as VTK expects."""
    xx, yy, zz, xy = stress.T
    zero = np.zeros_like(xx)
    return np.stack([xx, xy, zero, xy, yy, zero, zero, zero, zz], axis=1)
