"""Closed convex sets K with their projections in the inner product of a space."""

from .abstract import AbstractSet as AbstractSet
from .affine import AffineSubspace as AffineSubspace
from .ball import Ball as Ball
from .box import Box as Box
from .constrained_box import ConstrainedBox as ConstrainedBox
from .ellipsoid import Ellipsoid as Ellipsoid
from .half_space import HalfSpace as HalfSpace
from .hyperplane import Hyperplane as Hyperplane
from .intersection import Intersection as Intersection
from .l1_ball import L1Ball as L1Ball
from .polyhedron import Polyhedron as Polyhedron
from .product import Product as Product
from .scaled import Scaled as Scaled
from .second_order_cone import SecondOrderCone as SecondOrderCone
from .simplex import Simplex as Simplex
from .translated import Translated as Translated
from .whole import WholeSpace as WholeSpace
