"""Data as functions of time, with knots at which steps must end."""

from .abstract import AbstractSignal, SignalReports, listen
from .constant import Constant
from .function import Function
from .given import as_signal
from .product import Product
from .table import Table

__all__ = [
    "AbstractSignal",
    "Constant",
    "Function",
    "Product",
    "SignalReports",
    "Table",
    "as_signal",
    "listen",
]
