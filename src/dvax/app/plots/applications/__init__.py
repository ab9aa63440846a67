"""Pictures of the applications: a module a model, each with `pictures(data)`."""

import importlib
import pkgutil
from collections.abc import Mapping

import numpy as np

from dvax.app.plots.lines import LARGEST
from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable
from dvax.app.plots.theme import quantity
from dvax.app.runs.applications import models
from dvax.errors import input_error

NAMES = tuple(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__))
"""The applications that have pictures of their own: every module here."""

_MODELS = tuple(module.name.replace("_", "-") for module in pkgutil.iter_modules(models.__path__))
_DEFAULT = "python"


def application_pictures(name: str, data: Mapping[str, Variable]) -> list[Picture]:
    """Return the pictures of an application by its name, its own or the default ones, and that of
    its error bound.

    **Raises:** `dvax.InputError` for the name of no model: it comes from a file that may be damaged.
    """
    if name not in (*NAMES, *_MODELS):
        raise input_error(
            "manifest.json: model", repr(name),
            f"an application is one of {', '.join(_MODELS)}",
            "Restore the file from a copy, or run again with this version of dvax.",
        )  # fmt: skip
    own = name if name in NAMES else _DEFAULT
    module = importlib.import_module(f"dvax.app.plots.applications.{own.replace('-', '_')}")
    found = module.pictures(data)
    bound = data.get("error_bound")
    # Where no value can be drawn, the sentences of the report say all that there is to say.
    is_drawn = bound is not None and ((bound.values > 0.0) & (bound.values <= LARGEST)).any()
    return [*found, _certificate(data)] if is_drawn else found


def _certificate(data: Mapping[str, Variable]) -> Picture:
    """The bound on the error at the saved times."""
    bound = data["error_bound"]
    axis, status = bound.dims[0], bound.status
    # Only a proved bound is called certified.
    title = "Certified error" if status == "proved" else f"Error bound, {status}"
    curve = Curve(data[axis].values, bound.values, f"error bound ({status})", 1)
    panel = Panel([curve], f"error bound<br>({status})", bound.unit, log=True)
    words = f"A {bound.attrs.get('long_name', 'bound on the error of the state')}."
    above = ~(bound.values <= LARGEST)
    if above.any():
        first = quantity(float(data[axis].values[np.argmax(above)]), data[axis].unit)
        words += f" From {axis} = {first} on it states nothing."
    return panels_picture("certificate", title, words, [panel], axis, data[axis].unit)
