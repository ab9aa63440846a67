"""The public names of dvax: what its packages export, each at the shortest place."""

import functools
import importlib
import inspect
from collections import Counter
from collections.abc import Iterator

PACKAGES = {
    "dvax": "Problem, solve, events, methods, certificates",
    "dvax.generators": "the operators A with their semigroups",
    "dvax.operators": "the operators P",
    "dvax.sets": "the sets K with their projections",
    "dvax.spaces": "Hilbert spaces of states and controls",
    "dvax.signals": "measured data as functions of time",
    "dvax.vi": "the law at one time: solvers, certificates, analysis",
    "dvax.models": "ready models",
    "dvax.sensitivity": "derivatives at kinks and finite changes",
    "dvax.formats": "readers of files",
    "dvax.ensembles": "results of ensembles",
    "dvax.evolution": "results and classes behind `dvax.solve`",
    "dvax.theory": "results behind `dvax.verify` and `dvax.bound_error`",
}
"""Each public package and what it holds."""


def exported(package: str) -> Iterator[tuple[str, object]]:
    """The names that a package exports, without modules and without what it imports elsewhere."""
    module = importlib.import_module(package)
    names = getattr(module, "__all__", None) or [n for n in vars(module) if not n.startswith("_")]
    for name in names:
        thing = getattr(module, name)
        ours = getattr(thing, "__module__", "").split(".")[0] == "dvax"
        if ours and not inspect.ismodule(thing) and not name.startswith("__"):
            yield name, thing


@functools.cache
def public_names() -> dict[str, object]:
    """The objects by their public names; an object with several names has the first only."""
    names: dict[str, object] = {}
    seen: set[int] = set()
    for package in PACKAGES:
        for name, thing in exported(package):
            if id(thing) not in seen:
                seen.add(id(thing))
                names[f"{package}.{name}"] = thing
    return names


@functools.cache
def _places() -> dict[str, str]:
    """Public names by the place of the definition, `dvax.sets.box.Box`, and by other exports."""
    places = {}
    for name, thing in public_names().items():
        if hasattr(thing, "__qualname__"):
            places[f"{thing.__module__}.{thing.__qualname__}"] = name
    for package in PACKAGES:
        for name, thing in exported(package):
            for public, known in public_names().items():
                if known is thing:
                    places[f"{package}.{name}"] = public
    return places


def public_name_of(name: str) -> str | None:
    """Return the public name of what is defined at `name`, or None."""
    return name if name in public_names() else _places().get(name)


def _unique() -> dict[str, str]:
    """Short forms that mean one name: `Box`, `vi.Auto`, `models.Contact`, `verify`."""
    short: dict[str, str] = {}
    last = Counter(name.rpartition(".")[2] for name in public_names())
    for name in public_names():
        short[name.removeprefix("dvax.")] = name
        end = name.rpartition(".")[2]
        if last[end] == 1 and (end[0].isupper() or "_" in end):
            short[end] = name
    return short


UNIQUE = _unique()
