"""A configuration that stands on its own in a run directory."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import tomli_w

from dvax.app.runs.keys import set_key

if TYPE_CHECKING:
    from dvax.app.runs.applications.config import ModelConfig
    from dvax.app.runs.settings import Config

NAME = "config.resolved.toml"
DATA_FOLDER = "inputs"


def write_resolved(config: "Config | ModelConfig", directory: Path) -> Path:
    """Write the complete configuration and copies of its data files into a run directory.

    Reading the written file gives the same run, wherever the directory is moved. Returns the file's
    path. Raises `OSError` where the disk refuses.
    """
    tree = config.tree()
    for key, source in config.data_files():
        *tables, last = key.split(".")
        stem = "_".join(tables if last == "file" else [*tables, last])
        value = f"{DATA_FOLDER}/{stem}_{source.name}"
        target = directory / value
        if config.is_folder(key):
            value = f"{DATA_FOLDER}/{stem}"
            target = directory / value / source.name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
        set_key(tree, key, value)
    path = directory / NAME
    path.write_text(tomli_w.dumps(tree), encoding="utf-8")
    return path
