"""P: bounded, self-adjoint, coercive operators between the response u and y = P u."""

from .abstract import AbstractOperator as AbstractOperator
from .abstract import Spectrum as Spectrum
from .dense import Dense as Dense
from .diagonal import Diagonal as Diagonal
from .product import Product as Product
from .scaling import Scaling as Scaling
