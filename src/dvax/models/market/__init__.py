"""Electricity markets: Cournot firms under a sticky price, and the RTS-GMLC data."""

from .deviation import largest_gain as largest_gain
from .market import Market as Market
from .merit import MeritOrder as MeritOrder
