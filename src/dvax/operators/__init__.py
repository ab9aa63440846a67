"""Bounded, self-adjoint, coercive operators P, which map the response u to y = P u."""

from .abstract import AbstractOperator, Spectrum
from .convolution import Convolution
from .dense import Dense
from .diagonal import Diagonal
from .low_rank import LowRank
from .matrix_free import MatrixFree
from .product import Product
from .scaling import Scaling

__all__ = [
    "AbstractOperator",
    "Convolution",
    "Dense",
    "Diagonal",
    "LowRank",
    "MatrixFree",
    "Product",
    "Scaling",
    "Spectrum",
]
