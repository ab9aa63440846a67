"""Circuits with diodes: a netlist, its nodal analysis, and the system of the class."""

from .circuit import Circuit as Circuit
