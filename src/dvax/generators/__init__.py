"""Generators A of strongly continuous semigroups, with e^{hA}, φ-functions and growth bounds."""

from .abstract import AbstractGenerator as AbstractGenerator
from .abstract import AbstractPropagator as AbstractPropagator
from .abstract import FlowStep as FlowStep
from .abstract import Growth as Growth
from .dense import Dense as Dense
from .diagonal import Diagonal as Diagonal
from .elliptic import Elliptic as Elliptic
from .faber import Range as Range
from .finite_elements import FiniteElements as FiniteElements
from .kronecker import KroneckerSum as KroneckerSum
from .matrix_free import AbstractMatrixFree as AbstractMatrixFree
from .product import Product as Product
from .rotation import Rotation as Rotation
from .scalar import Scalar as Scalar
from .sparse import Sparse as Sparse
from .zero import Zero as Zero
