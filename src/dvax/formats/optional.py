"""What the extra `fem` brings, imported where it is needed: `import dvax` does without."""

import importlib
from typing import Any

from ..errors import input_error

_PACKAGES = {"skfem": "scikit-fem", "meshio": "meshio"}


def needed(module: str) -> Any:
    """The module `meshio`, `skfem`, or a module of it.

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
