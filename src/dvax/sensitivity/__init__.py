"""Derivatives of the solution map (ζ, η) ↦ (x, u), at kinks as well."""

from .change import Change as Change
from .change import change as change
from .degenerate import Kink as Kink
from .degenerate import kinks as kinks
from .directional import Directional as Directional
from .directional import directional_derivative as directional_derivative

__all__ = ["Change", "Directional", "Kink", "change", "directional_derivative", "kinks"]
