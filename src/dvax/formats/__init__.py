"""Readers of files of other programs. Each checks every cell and reports all problems with their lines.

Names are imported when they are first used: reading a table does not import meshio.
"""

from typing import TYPE_CHECKING

from .._lazy import lazy_names

if TYPE_CHECKING:
    from .at2 import read_at2 as read_at2
    from .mesh import read_mesh as read_mesh
    from .netlist import Netlist as Netlist
    from .netlist import read_netlist as read_netlist
    from .road_network import Network as Network
    from .road_network import Trips as Trips
    from .rts_gmlc import RTS as RTS
    from .rts_gmlc import read_rts as read_rts
    from .tntp import Flows as Flows
    from .tntp import read_flows as read_flows
    from .tntp import read_network as read_network
    from .tntp import read_nodes as read_nodes
    from .tntp import read_trips as read_trips

_HOMES = {
    "at2": ("read_at2",),
    "mesh": ("read_mesh",),
    "netlist": ("Netlist", "read_netlist"),
    "road_network": ("Network", "Trips"),
    "rts_gmlc": ("RTS", "read_rts"),
    "tntp": ("Flows", "read_flows", "read_network", "read_nodes", "read_trips"),
}
__all__, __getattr__, __dir__ = lazy_names(__name__, _HOMES)
