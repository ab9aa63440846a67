"""What a solver of the frozen variational inequality owes."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax

from .._tree import Tree
from ..sets import AbstractSet
from ..spaces import AbstractSpace

Operator = Callable[[Tree], Tree]


class RESULTS(eqx.Enumeration):
    """How a solve ended, in a sentence."""

    successful = "The tolerance was met."
    max_steps = (
        "The largest number of iterations was reached before the tolerance. The best iterate is "
        "returned with its bound; raise max_steps, loosen tol, or choose another solver."
    )
    stalled = (
        "The iterate stopped moving before the tolerance was met: rounding allows no more. The best "
        "iterate is returned with its bound; loosen tol, scale F, or use double precision."
    )
    cycling = (
        "The iterates came back to where they had been before: the method goes round in a circle, "
        "so F is not what it needs. Choose another solver; the bound of the best iterate holds."
    )
    diverging = (
        "The iterates left for infinity: VI(K, F) may have no solution, F may not be "
        "pseudomonotone, or a step was too long. Check F, or bound K."
    )
    singular = (
        "The linear systems of the method were singular to rounding, and its safeguard ran out of "
        "iterations. The best iterate is returned with its bound; choose a first-order solver, or "
        "raise max_steps."
    )
    nonfinite = (
        "The operator F or the projection returned NaN or infinity. Evaluate F at the returned y "
        "to see where."
    )
    no_bracket = (
        "No sign change of F was found on an unbounded interval, so F is not strongly "
        "pseudomonotone there. Bound the interval, or check the sign of F."
    )
    wrong_slope = (
        "F is affine with a slope that is not positive somewhere, so it is not strongly "
        "pseudomonotone and VI(K, F) may have no solution or several. Check the sign of F (of the "
        "way in which h depends on u)."
    )
    not_lipschitz = (
        "The step shrank to nothing: F jumps, or is steeper than floating-point numbers can "
        "resolve. Smooth F, or choose another solver."
    )


class Frozen(NamedTuple):
    """VI(K, F) in a space: find y ∈ K with ⟨F(y), v − y⟩ ≥ 0 for all v ∈ K.

    `gamma` and `L_F` are the moduli of F where they are known, None where not.
    """

    F: Operator
    K: AbstractSet
    space: AbstractSpace
    gamma: Any = None
    L_F: Any = None


class Answer(NamedTuple):
    """What a solver returns.

    `y` lies in K. `z` is a point whose projection is y: the unconstrained value of the law, which
    moves even while y sits on the boundary. `residual` is ‖w‖ for a w ∈ F(y) + N_K(y), so that
    ‖y − y*‖ ≤ residual/γ; it is 0 where y is the solution in closed form (up to rounding).
    `evaluations` counts calls of F, those for derivatives of F apart.
    """

    y: Tree
    z: Tree
    residual: jax.Array
    iterations: jax.Array
    result: RESULTS
    evaluations: jax.Array


class AbstractSolver(eqx.Module):
    """A method for VI(K, F). Its answer is differentiable with respect to all that F and K hold.

    `encloses` says that success means a y* enclosed to rounding, whatever F is there, and not a
    small ‖w‖.
    """

    encloses: ClassVar[bool] = False

    @abc.abstractmethod
    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        """Solve from the guess y0 until ‖w‖/γ ≤ tol, or ‖w‖ ≤ tol where γ is unknown."""
