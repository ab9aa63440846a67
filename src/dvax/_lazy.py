"""Packages whose public names are imported when they are first used."""

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def lazy_names(
    package: str, homes: Mapping[str, Sequence[str]], modules: Sequence[str] = ()
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__all__`, `__getattr__` and `__dir__` of a package.

    `homes` lists the names by the module of the package that defines them; `modules` are public
    themselves.
    """
    home_of = {name: home for home, names in homes.items() for name in names}
    public = [*modules, *home_of]

    def load(name: str) -> Any:
        if name not in public:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home = home_of.get(name)
        value = importlib.import_module(f".{home or name}", package)
        if home is not None:
            value = getattr(value, name)
        # Stored as an attribute, so that Python calls this function only once for each name.
        setattr(sys.modules[package], name, value)
        return value

    return public, load, lambda: sorted(public)
