"""Ready models: problems with proved constants and named results.

Each name is imported at its first use, so that a market does not import a mesh library.
"""

from typing import TYPE_CHECKING

from .._lazy import lazy_names

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
    from .model import Model as Model
    from .mpc import LinearMPC as LinearMPC
    from .rough_contact import RoughContact as RoughContact
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
    "model": ("Model",),
    "mpc": ("LinearMPC",),
    "rough_contact": ("RoughContact",),
    "thermostat": ("Thermostat",),
    "traffic": ("Incident", "Network", "Traffic", "Trips"),
}
__all__, __getattr__, __dir__ = lazy_names(__name__, _HOMES)
