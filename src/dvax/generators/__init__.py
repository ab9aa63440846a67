"""Generators A of strongly continuous semigroups, with e^{hA}, φ-functions and growth bounds."""

from .abstract import AbstractGenerator, AbstractPropagator, FlowStep, Growth
from .dense import Dense
from .diagonal import Diagonal
from .elliptic import Elliptic
from .faber import Range
from .finite_elements import FiniteElements
from .kronecker import KroneckerSum
from .matrix_free import AbstractMatrixFree
from .product import Product
from .rotation import Rotation
from .scalar import Scalar
from .sparse import Sparse
from .zero import Zero

__all__ = [
    "AbstractGenerator",
    "AbstractMatrixFree",
    "AbstractPropagator",
    "Dense",
    "Diagonal",
    "Elliptic",
    "FiniteElements",
    "FlowStep",
    "Growth",
    "KroneckerSum",
    "Product",
    "Range",
    "Rotation",
    "Scalar",
    "Sparse",
    "Zero",
]
