"""Day-to-day traffic on networks in the TNTP format."""

from ...formats import Network as Network
from ...formats import Trips as Trips
from .changes import Incident as Incident
from .law import LinkNewton as LinkNewton
from .traffic import Traffic as Traffic
