"""Slope arithmetic: enclosures of the values and derivatives of a program over a region."""

from .enclosure import RULES as RULES
from .enclosure import EnclosedSlopes as EnclosedSlopes
from .enclosure import SlopeEnclosure as SlopeEnclosure
from .values import MAX_ENTRIES as MAX_ENTRIES
from .values import Part as Part
from .values import Slope as Slope
from .values import TooLarge as TooLarge
from .values import Values as Values
from .values import columns as columns
from .values import interval as interval
from .values import is_slope as is_slope
