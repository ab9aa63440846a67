"""The theory of the paper in code: constants, stability, the a-posteriori error certificate."""

from . import formulas as formulas
from .assumptions import Assumption as Assumption
from .bound_error import bound_error as bound_error
from .certificate import Bound as Bound
from .constants import Constants as Constants
from .constants import Row as Row
from .parameter_bounds import parameter_bounds as parameter_bounds
from .parameters import ParameterBounds as ParameterBounds
from .status import Status as Status
from .status import weakest as weakest
from .verify import Verification as Verification
from .verify import verify as verify
