"""The fields of a body for ParaView and its kin."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import input_error
from ...formats.optional import needed
from .body import ElasticBody

_ENDINGS = (".vtu", ".vtk")


def write(
    body: ElasticBody,
    path: Path,
    displacement: np.ndarray,
    stress: np.ndarray,
    contact: Mapping[str, np.ndarray],
) -> tuple[Path, Path]:
    """Two files: the elements with the displacement of their nodes, and stress and von Mises' stress as
    means of each; and beside it the contact points with the fields of `contact`.

    **Raises:** `dvax.InputError` where the name has another ending than .vtu or .vtk, or its folder is
    not there.
    """
    if path.suffix not in _ENDINGS or not path.parent.is_dir():
        raise input_error(
            "dvax.models.FemContact.write(path)", repr(str(path)),
            f"it must be a name that ends on {' or '.join(_ENDINGS)}, in a folder that is there",
            "Make the folder, or fix the name",
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
    beside = path.with_name(f"{path.stem}-contact{path.suffix}")
    points = np.arange(len(body.points))[:, None]
    meshio.Mesh(_in_space(body.points), [("vertex", points)], point_data=dict(contact)).write(
        beside
    )
    return path, beside


def von_mises(stress: Any) -> np.ndarray:
    """√(½((σ_xx−σ_yy)² + (σ_yy−σ_zz)² + (σ_zz−σ_xx)²) + 3σ_xy²)."""
    xx, yy, zz, xy = np.asarray(stress).T
    return np.sqrt(0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) + 3 * xy**2)


def _in_space(vectors: np.ndarray) -> np.ndarray:
    return np.column_stack([vectors, np.zeros(len(vectors))])


def _tensor(stress: np.ndarray) -> np.ndarray:
    """The nine entries, row by row, as VTK keeps a tensor."""
    xx, yy, zz, xy = stress.T
    o = np.zeros_like(xx)
    return np.stack([xx, xy, o, xy, yy, o, o, o, zz], axis=1)
