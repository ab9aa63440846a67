"""Hilbert spaces, with the inner products of norms, adjoints, projections and constants."""

from .abstract import AbstractSpace as AbstractSpace
from .euclidean import Euclidean as Euclidean
from .l2 import L2 as L2
from .product import Product as Product
