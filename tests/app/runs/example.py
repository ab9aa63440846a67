"""A small configuration with small data, as a starting point of the tests."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

UNITS = {"time": "s", "length": "mm", "indentation": "um", "pressure": "MPa"}
EXAMPLE: dict[str, Any] = {
    "units": UNITS,
    "model": {
        "name": "contact",
        "alpha": 1.0,
        "beta": 2.0,
        "b_x": 0.8,
        "b_u": 0.6,
        "d_x": 0.3,
        "d_u": 0.5,
        "kappa0": 2.0,
    },
    "boundary": {"length": 20.0, "points": 8},
    "demand": {
        "profile": {"file": "strip.npy", "per_unit": "1 um"},
        "expression": "1 + 0.1*sin(t)",
    },
    "load": {"series": {"file": "load.csv"}, "expression": "1 + 0.3*cos(s)"},
    "time": {"end": 2.0, "frames": 4},
}
STRIP = np.linspace(-0.5, 1.5, 8)
LOAD = "time [s],load [um/s]\n0,0.5\n0.7,1.5\n1,-0.25\n2.5,1\n"
REMOVE = object()


def write(folder: Path, changes: dict[str, Any] | None = None, **files: str | bytes) -> Path:
    """The example with `changes` (dotted key -> value or REMOVE) beside files name_ext=content."""
    tree = copy.deepcopy(EXAMPLE)
    for key, value in (changes or {}).items():
        *path, last = key.split(".")
        table = tree
        for part in path:
            table = table.setdefault(part, {})
        if value is REMOVE:
            del table[last]
        else:
            table[last] = value
    np.save(folder / "strip.npy", STRIP)
    (folder / "load.csv").write_text(LOAD)
    for name, content in files.items():
        data = content if isinstance(content, bytes) else content.encode()
        (folder / ".".join(name.rsplit("_", 1))).write_bytes(data)
    path = folder / "run.toml"
    path.write_text(tomli_w.dumps(tree))
    return path
