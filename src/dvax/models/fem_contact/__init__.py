"""A viscoelastic finite-element body under a rigid punch."""

from .body import ElasticBody as ElasticBody
from .contact import FemContact as FemContact
from .equilibrium import Equilibrium as Equilibrium
