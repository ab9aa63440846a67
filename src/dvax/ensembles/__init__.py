"""Many runs of one problem: `dvax.ensemble`."""

from .ensemble import ensemble as ensemble
from .moments import Moments as Moments
from .result import Ensemble as Ensemble
from .result import Fold as Fold
