"""Step-size control: where each step ends, and whether it is accepted."""

from .adaptive import Adaptive as Adaptive
from .controller import AbstractController as AbstractController
from .controller import StepDecision as StepDecision
from .controller import clip_to_stop as clip_to_stop
from .controller import slack as slack
from .error_test import ErrorTest as ErrorTest
from .fixed import Fixed as Fixed
from .fixed import step_count as step_count
from .growth_limiter import MAX_GROWTH as MAX_GROWTH
from .tangent_limit import TangentLimit as TangentLimit
