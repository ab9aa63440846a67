"""Packages of the extra `fem`, imported where they are needed."""

import importlib
from typing import Any

from ..errors import input_error

_PACKAGES = {"skfem": "scikit-fem", "meshio": "meshio"}


def needed(module: str) -> Any:
    """Import the module `meshio`, `skfem`, or one of its modules.

    **Raises:** `dvax.InputError`, which names the extra, where it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise input_error(
            "dvax.models.ElasticBody",
            f"no module {module!r}",
            f"finite elements and mesh files are those of {_PACKAGES[module.split('.')[0]]}",
            'pip install "dvax[fem]"',
        ) from error
