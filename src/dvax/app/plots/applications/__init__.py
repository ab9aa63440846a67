"""Pictures of the applications: a module a model, each with `pictures(data)`."""

import importlib
import pkgutil
from collections.abc import Mapping

from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable
from dvax.errors import input_error

NAMES = tuple(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__))
"""The applications that have pictures: every module here."""


def application_pictures(name: str, data: Mapping[str, Variable]) -> list[Picture]:
    """Return the pictures of an application by its name.

    **Raises:** `dvax.InputError` where none is: the name comes from a file that may be damaged.
    """
    if name not in NAMES:
        raise input_error(
            "manifest.json: model", repr(name),
            f"an application is one of {', '.join(NAMES)}",
            "Restore the file from a copy, or run again with this version of dvax.",
        )  # fmt: skip
    module = importlib.import_module(f"dvax.app.plots.applications.{name.replace('-', '_')}")
    return module.pictures(data)
