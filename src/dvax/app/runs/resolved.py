"""A configuration that stands on its own in a run directory."""

import shutil
from pathlib import Path

from dvax.app.runs.contact_inputs import ContactInputs
from dvax.app.runs.settings import Config

NAME = "config.resolved.toml"
DATA_FOLDER = "inputs"


def write_resolved(config: Config, inputs: ContactInputs, directory: Path) -> Path:
    """Write the complete configuration and copies of its data files into a run directory.

    `load_config` of the written file gives the same run, wherever the directory is moved. Returns
    the file's path. Raises `OSError` where the disk refuses.
    """
    paths = {file.name: file.path for file in inputs.data_files}
    names: dict[str, str] = {}
    for key, name in config.data_files().items():
        source = paths[name]
        names[key] = f"{DATA_FOLDER}/{key.removesuffix('.file').replace('.', '_')}_{source.name}"
        target = directory / names[key]
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
    path = directory / NAME
    path.write_text(config.to_toml(names), encoding="utf-8")
    return path
