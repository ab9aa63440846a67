"""The frozen variational inequality VI(K, F): solvers, residuals, certificates, derivatives."""

from ..programs.structure import Structure, analyse, independent
from .abstract import RESULTS, AbstractSolver, Answer, FrozenVI
from .accelerated import Accelerated
from .active_set import ActiveSet
from .auto import Auto, ClosedForm
from .bracketing import Bracketing
from .certificate import Certificate, certify, natural_residual, residual_bound
from .extragradient import Extragradient
from .forward_backward_forward import ForwardBackwardForward
from .golden_ratio import GoldenRatio
from .lemke import Lemke
from .projection import Projection
from .refute import Counterexample, refute_gamma
from .semismooth_newton import SemismoothNewton
from .solve import VISolution, default_space, solve_vi
from .weighted import Modulus, Weighted

__all__ = [
    "RESULTS",
    "AbstractSolver",
    "Accelerated",
    "ActiveSet",
    "Answer",
    "Auto",
    "Bracketing",
    "Certificate",
    "ClosedForm",
    "Counterexample",
    "Extragradient",
    "ForwardBackwardForward",
    "FrozenVI",
    "GoldenRatio",
    "Lemke",
    "Modulus",
    "Projection",
    "SemismoothNewton",
    "Structure",
    "VISolution",
    "Weighted",
    "analyse",
    "certify",
    "default_space",
    "independent",
    "natural_residual",
    "refute_gamma",
    "residual_bound",
    "solve_vi",
]
