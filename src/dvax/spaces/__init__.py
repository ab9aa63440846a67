"""Hilbert spaces, with the inner products of norms, adjoints, projections and constants."""

from .abstract import AbstractSpace
from .euclidean import Euclidean
from .l2 import L2
from .product import Product

__all__ = [
    "L2",
    "AbstractSpace",
    "Euclidean",
    "Product",
]
