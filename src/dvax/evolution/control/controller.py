"""The interface of a step-size controller."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ..._tree import Tree
from ..results import RESULTS
from ..stepper import Step


class StepDecision(NamedTuple):
    """What becomes of one attempted step.

    - `accepted`: whether the step is accepted;
    - `state`: the state of the controller for the next attempt;
    - `jumped`: whether the step was accepted and ends at a stop, where the data may jump;
    - `result`: `RESULTS.successful`, or the reason for which the run ends here.
    """

    accepted: Any
    state: Any
    jumped: Any
    result: RESULTS


class AbstractController(eqx.Module):
    """Choose where each step ends.

    `stops` = (t₀, knots…, t₁) are the times at which a step must end; `adapts` says whether the ends
    of the other steps depend on the solution.
    """

    stops: eqx.AbstractVar[jax.Array]
    adapts: eqx.AbstractClassVar[bool]

    @abc.abstractmethod
    def init(self) -> Any:
        """Return the state before the first step."""

    @abc.abstractmethod
    def end(self, state: Any) -> Any:
        """Return the end of the next attempt."""

    @abc.abstractmethod
    def decide(self, t0: Any, t1: Any, x0: Tree, step: Step, state: Any) -> StepDecision:
        """Accept or reject the step that was attempted from (t0, x0) to t1."""

    @abc.abstractmethod
    def next_size(self, state: Any) -> Any:
        """Return the first step size for a run that is continued from here."""

    @abc.abstractmethod
    def step_start(self, index: Any, t: Any) -> Any:
        """Return the start of step number `index`, whose value is t, as a function of the stops. The
        ends of adaptive steps that are no stops are constants under differentiation."""


def clip_to_stop(t: Any, size: Any, stop: Any) -> Any:
    """Return the end of a step from t: `stop` where the step reaches it, half of the way where two
    such steps would pass it, so that no sliver is left, else t + size without rounding."""
    rest = stop - t
    reaches = size >= rest * (1 - 1e-9)
    inner = t + _multiple_of_spacing(t, jnp.where(2 * size > rest, 0.5 * rest, size))
    return jnp.where(reaches, stop, lax.stop_gradient(inner))


def _multiple_of_spacing(t: Any, size: Any) -> Any:
    """Return the step size rounded down to a multiple of the spacing of floating-point numbers at
    t + size, if it is not small against it.

    The end of the step is then exact, and so is its length. Otherwise steps that share one φ-function
    would all be longer, or all be shorter, than the time that they advance: after 10⁵ steps of 0.1 by
    2·10⁻⁸.
    """
    kind = jnp.finfo(size.dtype)
    # The nearest power of two of t + size, times ε, is the spacing there or twice that.
    spacing = kind.eps * lax.reduce_precision(jnp.abs(t) + size, kind.nexp, 0)
    rounded = jnp.floor(size / jnp.where(spacing > 0, spacing, 1)) * spacing
    return jnp.where(size > 16 * spacing, rounded, size)


def slack(t: Any) -> Any:
    """Return the largest distance at which t is taken for the end of a step: both are rounded."""
    return 4 * jnp.finfo(t.dtype).eps * jnp.abs(t)
