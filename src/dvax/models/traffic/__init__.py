"""Day-to-day traffic on networks in the TNTP format."""

from .changes import Incident as Incident
from .law import LinkNewton as LinkNewton
from .network import Network as Network
from .network import Trips as Trips
from .tntp import Flows as Flows
from .tntp import read_flows as read_flows
from .tntp import read_network as read_network
from .tntp import read_nodes as read_nodes
from .tntp import read_trips as read_trips
from .traffic import Traffic as Traffic
