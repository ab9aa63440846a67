"""dvax: coupled nonsmooth dynamical systems, solved with certified error bounds.

    x' = Ax + f(t, x, u) in the mild sense,      u ∈ h(t, x, u) − N_{K(t)}(P u)

Each name is imported at its first use, so that the command line starts without JAX.
"""

from typing import TYPE_CHECKING

from ._lazy import lazy_names

if TYPE_CHECKING:
    from . import formats as formats
    from . import generators as generators
    from . import models as models
    from . import operators as operators
    from . import sensitivity as sensitivity
    from . import sets as sets
    from . import signals as signals
    from . import spaces as spaces
    from . import vi as vi
    from ._version import __version__ as __version__
    from .ensembles import Ensemble as Ensemble
    from .ensembles import Fold as Fold
    from .ensembles import ensemble as ensemble
    from .errors import DifferentiationError as DifferentiationError
    from .errors import DvaxError as DvaxError
    from .errors import InputError as InputError
    from .errors import SolveError as SolveError
    from .evolution import ETD1 as ETD1
    from .evolution import ETD2RK as ETD2RK
    from .evolution import ETD4RK as ETD4RK
    from .evolution import RESULTS as RESULTS
    from .evolution import DormandPrince as DormandPrince
    from .evolution import Event as Event
    from .evolution import ExpRosenbrock as ExpRosenbrock
    from .evolution import Implicit as Implicit
    from .evolution import Picard as Picard
    from .evolution import PiecewiseLinear as PiecewiseLinear
    from .evolution import Solution as Solution
    from .evolution import ZarrStore as ZarrStore
    from .evolution import communication as communication
    from .evolution import export as export
    from .evolution import load_exported as load_exported
    from .evolution import solve as solve
    from .problem import Problem as Problem
    from .sensitivity import Directional as Directional
    from .sensitivity import directional_derivative as directional_derivative
    from .theory import Bound as Bound
    from .theory import Constants as Constants
    from .theory import ParameterBounds as ParameterBounds
    from .theory import Verification as Verification
    from .theory import bound_error as bound_error
    from .theory import parameter_bounds as parameter_bounds
    from .theory import verify as verify
    from .vi import solve_vi as solve_vi

_MODULES = (
    "formats",
    "generators",
    "models",
    "operators",
    "sensitivity",
    "sets",
    "signals",
    "spaces",
    "vi",
)
_HOMES = {
    "_version": ("__version__",),
    "ensembles": ("Ensemble", "Fold", "ensemble"),
    "errors": ("DifferentiationError", "DvaxError", "InputError", "SolveError"),
    "evolution": (
        "ETD1",
        "ETD2RK",
        "ETD4RK",
        "DormandPrince",
        "Event",
        "ExpRosenbrock",
        "Implicit",
        "Picard",
        "PiecewiseLinear",
        "RESULTS",
        "Solution",
        "ZarrStore",
        "communication",
        "export",
        "load_exported",
        "solve",
    ),
    "problem": ("Problem",),
    "sensitivity": ("Directional", "directional_derivative"),
    "theory": (
        "Bound",
        "Constants",
        "ParameterBounds",
        "Verification",
        "bound_error",
        "parameter_bounds",
        "verify",
    ),
    "vi": ("solve_vi",),
}
__all__, __getattr__, __dir__ = lazy_names(__name__, _HOMES, _MODULES)
