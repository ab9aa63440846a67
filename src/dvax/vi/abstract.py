"""The frozen variational inequality, the interface of its solvers, and what they return."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax

from .._tree import Tree
from ..sets import AbstractSet
from ..spaces import AbstractSpace

Operator = Callable[[Tree], Tree]


class RESULTS(eqx.Enumeration):
    """The result of a solve, with a message for the user.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> F, K = lambda y, q: 2.0 * y - q, dvax.sets.Box(0.0, 1.0)
    >>> vi = dvax.solve_vi(F, K, jnp.zeros(2), jnp.ones(2))
    >>> print(dvax.vi.RESULTS[vi.result])
    The tolerance was met.

    ```
    """

    successful = "The tolerance was met."
    max_steps = (
        "The largest number of iterations was reached before the tolerance. The best iterate is "
        "returned with its bound; raise max_steps, loosen tol, or choose another solver."
    )
    stalled = (
        "The iterates stopped changing before the tolerance was met, or rounding in F keeps the error "
        "bound above it. Rounding permits no smaller error. The best iterate is returned with its "
        "bound; loosen tol, scale F, or use double precision."
    )
    cycling = (
        "The iterates form a cycle: the method has returned to an earlier iterate, so F does not "
        "satisfy its assumptions. Choose another solver; the bound of the best iterate holds."
    )
    diverging = (
        "The iterates diverge: VI(K, F) may have no solution, F may not be pseudomonotone, or a "
        "step was too long. Check F, or bound K."
    )
    singular = (
        "The linear systems of the method were singular to working precision, and its safeguard "
        "reached max_steps. The best iterate is returned with its bound; choose a first-order "
        "solver, or raise max_steps."
    )
    nonfinite = (
        "The operator F or the projection returned NaN or infinity. Evaluate F at the returned y "
        "to find the entries."
    )
    no_bracket = (
        "No sign change of F was found on an unbounded interval, so F is not strongly "
        "pseudomonotone there. Bound the interval, or check the sign of F."
    )
    wrong_slope = (
        "F is affine with a slope that is not positive somewhere, so it is not strongly "
        "pseudomonotone and VI(K, F) may have no solution or several. Check the sign of F, that is, "
        "the sign with which h depends on u."
    )
    weight_not_positive = (
        "The weight a of a Weighted operator is not positive at y. y solves VI(K, G), but VI(K, aG) "
        "may have other solutions. Check a, or shrink K."
    )
    weight_below_bound = (
        "The weight a of a Weighted operator is below M at y: M is refuted as its lower bound, and "
        "with it γ = Mμ. y and its error bound remain valid, since they use μ alone. Lower M."
    )
    not_lipschitz = (
        "The step size fell below machine precision: F is discontinuous, or too steep for "
        "floating-point numbers. Smooth F, or choose another solver."
    )


class FrozenVI(NamedTuple):
    """VI(K, F) in a space: find y ∈ K with ⟨F(y), v − y⟩ ≥ 0 for all v ∈ K.

    `gamma` and `L_F` are the moduli of F, or None if they are unknown. If `rtol` is given, ‖w‖ must
    also be at most `rtol` times the size of the terms of w, but a ‖w‖ that is roundoff of these terms
    always suffices: a law in a time integration must be solved whatever its units are.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> space = dvax.spaces.Euclidean(2)
    >>> F, K = lambda y: 2.0 * y - 1.0, dvax.sets.Box(0.0, 0.25)
    >>> vi = dvax.vi.FrozenVI(F, K, space, gamma=2.0, L_F=2.0)
    >>> answer = dvax.vi.ClosedForm().solve(vi, jnp.zeros(2), 1e-10)
    >>> answer.y.tolist()
    [0.25, 0.25]

    ```
    """

    F: Operator
    K: AbstractSet
    space: AbstractSpace
    gamma: Any = None
    L_F: Any = None
    rtol: Any = None


@runtime_checkable
class HasInverse(Protocol):
    """An F that knows the inverse of its derivative, as the law of a problem does: F′ = aP⁻¹."""

    def inverse_up_to_a_factor(self, like: Tree) -> Callable[[Tree], Tree] | None:
        """Return P, self-adjoint in the space of the VI, with F′(y) = aP⁻¹ for all y and one number a
        that need not be known; None where the code does not show that there is one."""
        ...


class Answer(NamedTuple):
    """The result of a solver.

    - `y` ∈ K, the computed solution;
    - `z`, a point whose projection is y: the unconstrained value of the law, which changes even
      while y stays on the boundary of K;
    - `residual`, ‖w‖ for a w ∈ F(y) + N_K(y), so that ‖y − y*‖ ≤ residual/γ; 0 if y is the solution
      in closed form (up to rounding);
    - `evaluations`, the number of calls of F, without those for its derivatives;
    - `residual_step`, the λ in w = F(y) − F(b) + (b − y)/λ, by which the rounding of y is divided; ∞ if
      w has no such term.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> F = lambda y: 2.0 * y - 1.0
    >>> vi = dvax.vi.FrozenVI(F, dvax.sets.Box(0.0, 0.25), dvax.spaces.Euclidean(2))
    >>> answer = dvax.vi.ClosedForm().solve(vi, jnp.zeros(2), 1e-10)
    >>> answer.y.tolist(), answer.z.tolist()                         # y is the projection of z
    ([0.25, 0.25], [0.5, 0.5])

    ```
    """

    y: Tree
    z: Tree
    residual: jax.Array
    iterations: jax.Array
    result: RESULTS
    evaluations: jax.Array
    residual_step: Any = float("inf")


class AbstractSolver(eqx.Module):
    """A method for VI(K, F). Its answer is differentiable with respect to all arrays in F and K.

    If `certifies` is true, the method computes a w ∈ F(y) + N_K(y) and returns its norm as the
    residual. Otherwise y is a closed form or a bracketed root, and the caller must compute w.

    ```python
    >>> import dvax
    >>> solver = dvax.vi.Extragradient()
    >>> isinstance(solver, dvax.vi.AbstractSolver)
    True
    >>> print(f"{float(solver.contraction(1.0, 4.0)):.3f}")   # of an iteration, for γ = 1 and L_F = 4
    0.890

    ```
    """

    certifies: ClassVar[bool] = True

    @abc.abstractmethod
    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        """Solve from the guess y0 until ‖w‖/γ ≤ tol, or ‖w‖ ≤ tol if γ is unknown."""
