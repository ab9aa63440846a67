"""VTK: a ParaView series, NAME.pvd with one file for each frame in the folder NAME-frames.

A field is a variable over time and over the points of a line (.vtp, one polyline) or of a rectangle
(.vtr, a rectilinear grid). The values are base64 of the little-endian numbers, behind their length in
bytes (VTK's file formats, "inline binary").
"""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.store import Variable
from dvax.app.runs.export.selection import Selection, blocks
from dvax.errors import input_error

SUFFIX = ".pvd"
_TYPES = {"f8": "Float64", "f4": "Float32", "i1": "Int8", "i2": "Int16", "i4": "Int32", "i8": "Int64",
          "u1": "UInt8", "b1": "UInt8"}  # fmt: skip


@dataclass(frozen=True)
class Series:
    """The fields over the points of one dimension, and where these points are: `axes` has one array of
    coordinates for a line, and two for a rectangle, whose points are in C order."""

    dim: str
    axes: tuple[np.ndarray, ...]
    order: np.ndarray
    fields: Mapping[str, Variable]


def parts(selection: Selection) -> dict[str, Any]:
    """Return, by the name of each series, the function that writes it to a path.

    **Raises:** `dvax.InputError` if the selection has no field.
    """
    found = _all_series(selection)
    if not found:
        raise _without_fields(selection)
    return {series.dim: _writer(selection, series) for series in found}


def notes(selection: Selection) -> list[str]:
    if (selection.run.directory / "body.vtu").is_file():
        return ["The run wrote body.vtu, the body at its end, into its own folder."]
    return []


def frames_folder(path: Path) -> Path:
    """Return the folder for the frames of a series."""
    return path.with_name(f"{path.stem}-frames")


def _all_series(selection: Selection) -> list[Series]:
    by_dim: dict[str, dict[str, Variable]] = {}
    for name, v in selection.data.items():
        if len(v.dims) == 2 and v.dims[0] == "time" and v.dtype.str[1:] in _TYPES:
            by_dim.setdefault(v.dims[1], {})[name] = v
    found = []
    for dim, fields in by_dim.items():
        places = _places(selection, dim)
        if len(places) == 1:
            (place,) = places
            found.append(Series(dim, (place,), np.argsort(place, kind="stable"), fields))
        elif len(places) == 2:
            shape = selection.run.boundary_shape
            s1, s2 = (place.reshape(shape) for place in places)
            # VTK counts the first coordinate fastest, C order the last.
            order = np.arange(s1.size).reshape(shape).T.reshape(-1)
            found.append(Series(dim, (s1[:, 0], s2[0]), order, fields))
    return found


def _places(selection: Selection, dim: str) -> list[np.ndarray]:
    """Return the coordinates of the points of a dimension, none where they are not known."""
    on_line = [n for n in (dim, "s") if n in selection.coordinates]
    names = on_line[:1] or [n for n in ("s1", "s2") if n in selection.coordinates]
    places = [selection.variables[n] for n in names if selection.variables[n].dims == (dim,)]
    return [np.asarray(p.values, float) for p in places]


def _writer(selection: Selection, series: Series) -> Any:
    times = np.asarray(selection.variables["time"].values, float)
    names = [f"frame-{k:0{len(str(len(times)))}d}{_ending(series)}" for k in range(len(times))]

    def write(path: Path) -> None:
        folder = frames_folder(path)
        folder.mkdir()
        fields = series.fields
        for block in blocks(list(fields.values()), len(times)):
            rows = {n: v.frames(block)[:, series.order] for n, v in fields.items()}
            for k in range(block.start, block.stop):
                values = {n: row[k - block.start] for n, row in rows.items()}
                (folder / names[k]).write_text(_frame(series, values), encoding="utf-8")
        entries = (
            f'<DataSet timestep="{t!r}" part="0" file={quoteattr(f"{folder.name}/{name}")}/>'
            for t, name in zip(times.tolist(), names, strict=True)
        )
        path.write_text(_document("Collection", "\n".join(entries)), encoding="utf-8")

    return write


def _ending(series: Series) -> str:
    return ".vtp" if len(series.axes) == 1 else ".vtr"


def _frame(series: Series, values: Mapping[str, np.ndarray]) -> str:
    """Return the file of one frame."""
    data = "".join(_array(name, row) for name, row in values.items())
    point_data = f"<PointData>{data}</PointData>"
    if len(series.axes) == 2:
        extent = " ".join(f"0 {len(axis) - 1}" for axis in series.axes) + " 0 0"
        axes = "".join(_array(n, a) for n, a in zip("xyz", (*series.axes, np.zeros(1))))
        coordinates = f"<Coordinates>{axes}</Coordinates>"
        piece = f'<Piece Extent="{extent}">{point_data}{coordinates}</Piece>'
        return _document("RectilinearGrid", piece, f' WholeExtent="{extent}"')
    (place,) = series.axes
    count = len(place)
    points = np.column_stack([place[series.order], np.zeros((count, 2))])
    line = _array("connectivity", np.arange(count)) + _array("offsets", np.array([count]))
    piece = (
        f'<Piece NumberOfPoints="{count}" NumberOfVerts="0" NumberOfLines="1" NumberOfStrips="0" '
        f'NumberOfPolys="0">{point_data}<Points>{_array("points", points)}</Points>'
        f"<Lines>{line}</Lines></Piece>"
    )
    return _document("PolyData", piece)


def _document(kind: str, content: str, attributes: str = "") -> str:
    return (
        f'<?xml version="1.0"?>\n<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" '
        f'header_type="UInt64">\n<{kind}{attributes}>\n{content}\n</{kind}>\n</VTKFile>\n'
    )


def _array(name: str, values: np.ndarray) -> str:
    little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    raw = little.tobytes()
    text = base64.b64encode(len(raw).to_bytes(8, "little") + raw).decode()
    kind = _TYPES[little.dtype.str[1:]]
    components = values.shape[1] if values.ndim == 2 else 1
    return (
        f'<DataArray type="{kind}" Name={quoteattr(name)} NumberOfComponents="{components}" '
        f'format="binary">{text}</DataArray>\n'
    )


def _without_fields(selection: Selection) -> Exception:
    run: RunRecord = selection.run
    return input_error(
        "--format vtk", f"a run of the model {run.model} with {', '.join(selection.data)}",
        "VTK shows fields over time on a boundary whose coordinates the run holds, and there is none",
        "Write NetCDF or CSV instead: -o results.nc",
    )  # fmt: skip
