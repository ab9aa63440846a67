"""Data as functions of time, with knots at which steps must end."""

from .abstract import AbstractSignal as AbstractSignal
from .abstract import SignalReports as SignalReports
from .abstract import listen as listen
from .constant import Constant as Constant
from .function import Function as Function
from .given import as_signal as as_signal
from .product import Product as Product
from .table import Table as Table
