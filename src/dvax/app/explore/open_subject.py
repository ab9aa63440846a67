"""From the argument of `dvax explore` to what is explored."""

from pathlib import Path

from dvax.app.explore.contact import ContactSubject, load_default
from dvax.app.explore.model import ModelSubject
from dvax.app.explore.saved import SavedRun
from dvax.app.explore.subject import AbstractSubject
from dvax.app.runs.applications.config import ModelConfig, read_config
from dvax.app.runs.sweeps.records import is_sweep
from dvax.errors import input_error


def open_subject(
    target: Path | None, *, allow_outside: bool = False, allow_code: bool = False
) -> AbstractSubject:
    """Return the contact law with its defaults, a configuration, or a run directory.

    **Raises:** `dvax.InputError`.
    """
    if target is None:
        return ContactSubject(load_default())
    if not target.exists():
        raise input_error(
            str(target), "no such file or folder",
            "it is a configuration, or the folder of a run",
            "Give CONFIG.toml or DIR, or leave it out for the contact law",
        )  # fmt: skip
    if target.is_dir():
        if is_sweep(target):
            raise input_error(
                str(target), "the folder of a sweep", "one run is explored",
                "Give the folder of one of its members, or its configuration",
            )  # fmt: skip
        return SavedRun(target)
    config = read_config(target, allow_outside=allow_outside, quiet=True, allow_code=allow_code)
    if isinstance(config, ModelConfig):
        return ModelSubject(config, allow_outside)
    return ContactSubject(config)
