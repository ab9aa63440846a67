"""A configuration and its data at another number of points, as files of their own."""

import shutil
import tomllib
from pathlib import Path
from typing import Any

FIELDS = ("demand", "load", "initial")


def resample(config: Path, folder: Path, points: int) -> Path:
    """Write `config` and the data it names into `folder`, its curve sampled at `points` midpoints.

    Profiles with a value a point are interpolated by straight lines between the old midpoints (and
    held beyond the outermost); all else is copied. Returns the path of the new configuration.
    """
    import numpy as np
    import tomli_w

    content: dict[str, Any] = tomllib.loads(config.read_text(encoding="utf-8-sig"))
    old = int(content["boundary"]["points"])
    content["boundary"]["points"] = points
    at = (np.arange(points) + 0.5) / points
    known = (np.arange(old) + 0.5) / old
    for field in FIELDS:
        for factor in ("series", "profile"):
            data = content.get(field, {}).get(factor)
            if data is None:
                continue
            source, copy = config.parent / data["file"], folder / data["file"]
            if source.suffix == ".npy":
                np.save(copy, np.interp(at, known, np.load(source, allow_pickle=False)))
            else:
                shutil.copyfile(source, copy)
    written = folder / config.name
    written.write_text(tomli_w.dumps(content), encoding="utf-8")
    return written
