"""Ready models: a problem with its constants and what its figures mean.

Names are loaded when they are first used: nobody needs a mesh for a market.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .circuit import Circuit as Circuit
    from .contact import Contact as Contact
    from .duvaut_lions import DruckerPrager as DruckerPrager
    from .duvaut_lions import DuvautLions as DuvautLions
    from .duvaut_lions import VonMises as VonMises
    from .fem_contact import ElasticBody as ElasticBody
    from .fem_contact import FemContact as FemContact
    from .frame import Accelerogram as Accelerogram
    from .frame import Frame as Frame
    from .frame import response_spectrum as response_spectrum
    from .market import Market as Market
    from .mpc import LinearMPC as LinearMPC
    from .thermostat import Thermostat as Thermostat
    from .traffic import Incident as Incident
    from .traffic import Network as Network
    from .traffic import Traffic as Traffic
    from .traffic import Trips as Trips

_HOMES = {
    "circuit": ("Circuit",),
    "contact": ("Contact",),
    "duvaut_lions": ("DruckerPrager", "DuvautLions", "VonMises"),
    "fem_contact": ("ElasticBody", "FemContact"),
    "frame": ("Accelerogram", "Frame", "response_spectrum"),
    "market": ("Market",),
    "mpc": ("LinearMPC",),
    "thermostat": ("Thermostat",),
    "traffic": ("Incident", "Network", "Traffic", "Trips"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [*_HOME_OF]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name in _HOME_OF:
        value = getattr(importlib.import_module(f".{_HOME_OF[name]}", __name__), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'dvax.models' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
