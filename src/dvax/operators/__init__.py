"""Bounded, self-adjoint, coercive operators P, which map the response u to y = P u."""

from .abstract import AbstractOperator as AbstractOperator
from .abstract import Spectrum as Spectrum
from .convolution import Convolution as Convolution
from .dense import Dense as Dense
from .diagonal import Diagonal as Diagonal
from .low_rank import LowRank as LowRank
from .matrix_free import MatrixFree as MatrixFree
from .product import Product as Product
from .scaling import Scaling as Scaling
