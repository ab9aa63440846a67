"""Circuits with diodes: a netlist, its nodal analysis, and the system of the class."""

from .circuit import Circuit as Circuit
from .netlist import Netlist as Netlist
from .netlist import read_netlist as read_netlist
