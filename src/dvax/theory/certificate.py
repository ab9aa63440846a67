"""The a-posteriori certificate: how far the computed trajectory is from the true one.

Let x_h solve x_h' = A x_h + p exactly (every exponential method does, with p its stage polynomial),
and let δ(s) = ‖p(s) − f̃(s, x_h(s))‖. Subtracting the mild equations,

    ‖x_h − x‖(t) ≤ M e^{ωt}‖x_h(0) − x₀‖ + M ∫₀ᵗ e^{ω(t−s)} (δ(s) + L̃‖x_h − x‖(s)) ds,

and Gronwall's lemma gives, with c = ω + M L̃,

    ‖x_h − x‖(t) ≤ M e^{ct}‖x_h(0) − x₀‖ + M ∫₀ᵗ e^{c(t−s)} δ(s) ds.

A never enters δ, so the bound is finite for a partial differential equation. Where f̃ is only
evaluated through a law solved to ‖w‖, δ gains β_f‖P⁻¹‖‖w‖/γ. With a one-sided constant μ the same
holds with M = 1 and c = μ: d/dt‖x_h − x‖ ≤ μ‖x_h − x‖ + δ. The response follows, since
‖u_h − u‖ ≤ L‖x_h − x‖ + ‖u_h − u_{x_h}‖.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from ..errors import InputError, InputProblem
from ..evolution import Solution, solve
from ..problem import Problem
from .constants import Constants
from .status import Status, weakest


class Bound(eqx.Module):
    """Bounds on the true error at the saved times of a solution.

    - `ts`; `x` ≥ ‖x_h − x‖ and `u` ≥ ‖u_h − u‖ with the paper's constants;
    - `x_sharp`, `u_sharp`: the same with the one-sided constant, or None where it is not known;
    - `status`: the weakest of what the bound rests on. The defect between its samples is an
      estimate (`dvax.evolution`), so that a bound is at best "estimated" unless the model encloses
      it.

    Bounds hold up to floating-point rounding in the solve itself.
    """

    ts: jax.Array
    x: jax.Array
    u: jax.Array
    x_sharp: jax.Array | None
    u_sharp: jax.Array | None
    status: Status = eqx.field(static=True)


def bound_error(
    problem: Problem, sol: Solution, constants: Constants, *, initial_error: Any = 0.0
) -> Bound:
    """Bound the error of a computed trajectory at its saved times.

    **Arguments:** `problem` and `sol`, the solution of it; `constants`; `initial_error`, a bound on
    ‖x_h(t0) − x(t0)‖.

    Where the solve did not measure its defect (fixed steps), it is run again with `measure=True`,
    and the distance between the two runs, which is rounding, is added.

    **Raises:** `dvax.InputError` where `sol` is not a solution of `problem`.

    ```python
    >>> import dvax
    >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
    ...                             kappa0=0.5, g=1.0, ell=3.0)
    >>> sol = dvax.solve(model.problem, -1.0, 0.0, 2.0, rtol=1e-6)
    >>> bound = dvax.bound_error(model.problem, sol, model.constants)
    >>> bool(bound.x[-1] >= abs(sol.xs[-1] - 1.8360919559905713))
    True

    ```
    """
    if sol.setup.problem is not problem and sol.setup.problem != problem:
        raise InputError(
            InputProblem(
                "dvax.bound_error(problem, sol)",
                "a solution of another problem",
                "the certificate evaluates the defect of this problem",
                "Pass the problem that was solved",
            )
        )
    space = problem.spaces(jtu.tree_map(lambda leaf: leaf[0], sol.xs))[0]
    measured, apart = sol, jnp.zeros_like(sol.ts)
    if sol.defect is None:
        measured = _again(problem, sol)
        apart = jax.vmap(lambda a, b: space.norm(_tree.sub(a, b)))(measured.xs, sol.xs)
    assert measured.defect is not None and measured.law_defect is not None

    c = constants
    law_gain = c.beta_f * c.norm_P_inv / c.gamma
    impulse = measured.defect + law_gain * measured.law_defect
    assert measured.settled is not None
    settled = measured.settled[0] + law_gain * measured.settled[1]
    law_error = sol.law_error
    if law_error is None:
        law_error = c.norm_P_inv * sol.law_residual / c.gamma
    t0 = jnp.asarray(sol.setup.setting["t0"], sol.ts.dtype)

    def propagated(rate: Any, M: Any) -> jax.Array:
        return _gronwall(t0, sol.ts, impulse, settled, rate, M, initial_error) + apart

    x = propagated(c.growth_rate, c.M)
    sharp = None if c.one_sided is None else propagated(c.one_sided, 1.0)
    return Bound(
        ts=sol.ts,
        x=x,
        u=c.L * x + law_error,
        x_sharp=sharp,
        u_sharp=None if sharp is None else c.L * sharp + law_error,
        status=weakest(
            c.status_of(*(name for name, _ in c.statuses)),
            "proved" if measured.enclosed else "estimated",
        ),
    )


@jax.jit
def _gronwall(
    t0: Any, ts: Any, impulse: Any, settled: Any, rate: Any, M: Any, initial: Any
) -> jax.Array:
    """M e^{ct} e₀ + M ∫ e^{c(t−s)} dI(s), from the impulse I known at the saved times only.

    Between two saved times the impulse may have acted at any moment, so each one is charged
    e^{c₊Δ}; and a step under way at a saved time is charged again after it, since nothing says how
    much of it had acted. Saving more often makes the bound sharper where trajectories approach.
    """

    def advance(carry: tuple, now: tuple) -> tuple:
        before, t, acted = carry
        time, total, surely = now
        span = time - t
        after = jnp.exp(rate * span) * before
        after = after + M * jnp.exp(jnp.maximum(rate, 0.0) * span) * (total - acted)
        return (after, time, surely), after

    start = (jnp.asarray(M * initial, ts.dtype), t0, jnp.zeros((), ts.dtype))
    return lax.scan(advance, start, (ts, impulse, settled))[1]


def _again(problem: Problem, sol: Solution) -> Solution:
    was = sol.setup
    return solve(
        problem, was.x0, was.setting["t0"], was.setting["t1"], was.args, sol.ts, was.setting["dt"],
        method=was.method, vi_solver=was.vi_solver, measure=True,
    )  # fmt: skip
