"""The frozen variational inequality VI(K, F): solvers, residuals, certificates, derivatives."""

from .abstract import RESULTS as RESULTS
from .abstract import AbstractSolver as AbstractSolver
from .abstract import Answer as Answer
from .abstract import Frozen as Frozen
from .active_set import ActiveSet as ActiveSet
from .auto import Auto as Auto
from .auto import Closed as Closed
from .bracketing import Bracketing as Bracketing
from .certificate import Certified as Certified
from .certificate import certify as certify
from .certificate import natural_residual as natural_residual
from .certificate import residual_bound as residual_bound
from .extragradient import Extragradient as Extragradient
from .forward_backward_forward import ForwardBackwardForward as ForwardBackwardForward
from .golden_ratio import GoldenRatio as GoldenRatio
from .projection import Projection as Projection
from .semismooth_newton import SemismoothNewton as SemismoothNewton
from .solve import VISolution as VISolution
from .solve import default_space as default_space
from .solve import solve_vi as solve_vi
from .structure import Structure as Structure
from .structure import analyse as analyse
from .structure import independent as independent
