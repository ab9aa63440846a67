"""A viscoelastic body of finite elements under a rigid punch."""

from .body import ElasticBody as ElasticBody
from .contact import FemContact as FemContact
from .rest import Equilibrium as Equilibrium
