"""Closed convex sets K: projection, membership, normal cone, in the inner product of a space."""

from .abstract import AbstractSet as AbstractSet
from .ball import Ball as Ball
from .box import Box as Box
from .product import Product as Product
from .whole import WholeSpace as WholeSpace
