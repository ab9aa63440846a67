"""Pictures of the applications: a module a model, each with `pictures(data)`."""

import importlib
from collections.abc import Mapping

from dvax.plots.applications.data import Data
from dvax.plots.picture import Picture

MODULES = {
    "traffic": "traffic",
    "market": "market",
    "frame": "frame",
    "circuit": "circuit",
    "fem-contact": "fem_contact",
}


def application_pictures(name: str, data: Mapping[str, Data]) -> list[Picture]:
    """The pictures of the application that is called so."""
    module = importlib.import_module(f"dvax.plots.applications.{MODULES[name]}")
    return module.pictures(data)
