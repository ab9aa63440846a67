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
        "The iterate stopped moving before the tolerance was met, or rounding in F keeps its error "
        "bound above it: rounding allows no more. The best iterate is returned with its bound; "
        "loosen tol, scale F, or use double precision."
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
    weight_not_positive = (
        "The weight a of a Weighted operator is not positive at y. y solves VI(K, G), but then need "
        "not solve VI(K, aG), and others may. Check a, or shrink K."
    )
    weight_below_bound = (
        "The weight a of a Weighted operator is below M at y: M is refuted as its lower bound, and "
        "with it γ = Mμ. y and its error bound, which rests on μ alone, hold. Lower M."
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
    `evaluations` counts calls of F, those for derivatives of F apart. `length` is the λ that w was
    divided by, with the roundings of y: w = F(y) − F(·) + (· − y)/λ; ∞ where it was not.
    """

    y: Tree
    z: Tree
    residual: jax.Array
    iterations: jax.Array
    result: RESULTS
    evaluations: jax.Array
    length: Any = float("inf")


class AbstractSolver(eqx.Module):
    """A method for VI(K, F). Its answer is differentiable with respect to all that F and K hold.

    `certifies` says that the residual is the norm of a w ∈ F(y) + N_K(y) that the method has found.
    Where it is not, y is a closed form, or enclosed to rounding, and its w is still to be computed.
    """

    certifies: ClassVar[bool] = True

    @abc.abstractmethod
    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        """Solve from the guess y0 until ‖w‖/γ ≤ tol, or ‖w‖ ≤ tol where γ is unknown."""
