"""Hilbert spaces: the inner product that norms, adjoints, projections and constants refer to."""

from .abstract import AbstractSpace as AbstractSpace
from .euclidean import Euclidean as Euclidean
from .l2 import L2 as L2
from .product import Product as Product
