"""Data as functions of time, with the knots that a step must not jump over."""

from .abstract import AbstractSignal as AbstractSignal
from .abstract import Heard as Heard
from .abstract import listen as listen
from .constant import Constant as Constant
from .function import Function as Function
from .given import as_signal as as_signal
from .product import Product as Product
from .table import Table as Table
