"""Closed convex sets K with their projections in the inner product of a space."""

from .abstract import AbstractSet
from .affine import AffineSubspace
from .ball import Ball
from .box import Box
from .constrained_box import ConstrainedBox
from .ellipsoid import Ellipsoid
from .half_space import HalfSpace
from .hyperplane import Hyperplane
from .intersection import Intersection
from .l1_ball import L1Ball
from .polyhedron import Polyhedron
from .product import Product
from .scaled import Scaled
from .second_order_cone import SecondOrderCone
from .simplex import Simplex
from .translated import Translated
from .whole import WholeSpace

__all__ = [
    "AbstractSet",
    "AffineSubspace",
    "Ball",
    "Box",
    "ConstrainedBox",
    "Ellipsoid",
    "HalfSpace",
    "Hyperplane",
    "Intersection",
    "L1Ball",
    "Polyhedron",
    "Product",
    "Scaled",
    "SecondOrderCone",
    "Simplex",
    "Translated",
    "WholeSpace",
]
