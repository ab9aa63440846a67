"""The mild solution: exponential integrators, step control, `solve`, `Solution`."""

from .bounds import Bounds as Bounds
from .communication import Collective as Collective
from .communication import Communication as Communication
from .communication import communication as communication
from .event import Event as Event
from .event import Events as Events
from .exported import Exported as Exported
from .exported import ExportedSolution as ExportedSolution
from .exported import load_exported as load_exported
from .exporting import export as export
from .growth import between as between
from .growth import disturbance as disturbance
from .growth import gronwall as gronwall
from .implicit import Implicit as Implicit
from .method import ETD1 as ETD1
from .method import ETD2RK as ETD2RK
from .method import ETD4RK as ETD4RK
from .method import AbstractMethod as AbstractMethod
from .method import ExpRosenbrock as ExpRosenbrock
from .picard import Picard as Picard
from .piecewise.method import PiecewiseLinear as PiecewiseLinear
from .results import RESULTS as RESULTS
from .runge_kutta import DormandPrince as DormandPrince
from .solution import Solution as Solution
from .solve import solve as solve
from .zarr_store import ZarrStore as ZarrStore
