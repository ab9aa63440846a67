"""What was asked of a solve, and the flow that it settles."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..problem import Problem
from ..sets import AbstractSet
from ..vi import AbstractSolver, Auto, analyse, independent
from . import written
from .chords import NoEnclosure, constant
from .faces import faces
from .flow import Flow, slope
from .implicit import Implicit
from .linearised import Nothing
from .medians import Medians
from .method import AbstractMethod
from .picard import Picard
from .piecewise.method import PiecewiseLinear


class Setup(NamedTuple):
    """The arguments of a solve that its solution is a function of.

    `setting` holds the numbers: t0, t1, dt (NaN for adaptive steps), rtol, atol, dt0, horizon;
    `moduli` those of γ, L_F and ‖P⁻¹‖ that are known. A plain tuple: one is made at every call.
    """

    problem: Problem
    x0: Tree
    args: Any
    setting: dict[str, Any]
    method: AbstractMethod | Implicit | Picard | PiecewiseLinear
    vi_solver: AbstractSolver
    moduli: dict[str, Any]

    @property
    def dtype(self) -> Any:
        """The floating type of the state, which time shares."""
        return jnp.result_type(*jtu.tree_leaves(self.x0))

    def number(self, name: str) -> jax.Array:
        """An entry of `setting`, in the type of the state."""
        return jnp.asarray(self.setting[name], self.dtype)

    def is_valid(self, ts: Any) -> jax.Array:
        """Whether the numbers obey the rules of `arguments.check`, which cannot look at traced ones."""
        number = self.number
        lengths = jnp.stack([number(name) for name in ("dt0", "dt_max", "horizon")])
        # dt is NaN where steps adapt.
        positive = jnp.all(lengths > 0) & ~(number("dt") <= 0)
        rtol, atol = number("rtol"), number("atol")
        tolerances = (rtol >= 0) & (atol >= 0) & (rtol + atol > 0)
        forward = number("t1") > number("t0")
        if ts is not None:
            forward &= jnp.min(jnp.asarray(ts, self.dtype)) >= number("t0")
        return forward & positive & tolerances

    def flow(self) -> Flow:
        """The reduced map, with what the code of f, h and K proves about the law put to use."""
        problem, x0, vi_solver = self.problem, self.x0, self.vi_solver
        args = as_arrays(self.args)
        t0 = self.number("t0")
        like = problem.zero_control(x0)
        K = problem.set_at(t0, args)
        frozen = problem.frozen(t0, x0, args)
        structure = analyse(frozen, like)
        intervals = structure.pointwise and structure.affine and K.intervals(like) is not None
        closed = intervals or (structure.isotropic and not isinstance(like, tuple))
        solver = vi_solver
        if isinstance(vi_solver, Auto):
            solver = vi_solver.choose(frozen, K, like)
        direct = closed and isinstance(vi_solver, Auto)
        operator = problem.operator(args)
        solved = None
        if not closed and isinstance(vi_solver, Auto) and structure.affine and written.fits(like):
            solved = self._written_out(frozen, K, like)
        reciprocal = None
        if direct and independent(lambda t, x: slope(problem, operator, t, x, args), t0, x0):
            reciprocal = jtu.tree_map(jnp.reciprocal, slope(problem, operator, t0, x0, args))
            if structure.isotropic:
                # One number a part: read from memory once, not once an entry.
                reciprocal = jtu.tree_map(lambda leaf: leaf.ravel()[0], reciprocal)
        flow = Flow(
            problem, args, problem.generator(args), operator, solver, direct or solved is not None,
            reciprocal, False, self._tolerance(), self.moduli.get("gamma"), self.moduli.get("L_F"),
            solved,
        )  # fmt: skip
        if isinstance(self.method, AbstractMethod) and self.method.explicit_in_A:
            flow = dataclasses.replace(flow, linear=Nothing(flow.generator))
        line = not isinstance(self.method, Implicit) and self.method.degree <= 1
        if direct and intervals and line and _can_enclose(flow, t0, x0):
            return dataclasses.replace(flow, enclosed=True)
        return flow

    def _written_out(
        self, frozen: Any, K: AbstractSet, like: Tree
    ) -> written.AbstractWritten | None:
        """The law written out, where its matrix does not depend on t and x."""
        problem, x0, args, t0 = self.problem, self.x0, as_arrays(self.args), self.number("t0")
        push = lambda t, x: jax.jacfwd(problem.frozen(t, x, args))(like)  # noqa: E731
        if K.intervals(like) is None or not independent(push, t0, x0):
            return None
        flat = jnp.zeros_like(like).ravel()
        M = jax.jacfwd(lambda v: frozen(v.reshape(like.shape)).ravel())(flat)
        return Medians(M) if like.size == 2 else faces(M)

    def _tolerance(self) -> jax.Array:
        """Of the law: a thousandth of what the defect may be, and no less than rounding allows."""
        floor = 100 * jnp.finfo(self.dtype).eps
        defect = self.number("atol") + self.number("rtol")
        adaptive = 1e-3 * defect / jnp.maximum(1.0, self.number("horizon"))
        fixed = jnp.isnan(self.number("dt"))
        return jnp.maximum(jnp.where(fixed, adaptive, 1e-12), floor)


def as_arrays(args: Any) -> Any:
    """Every Python number with a point as the array that f and h are always handed; integers and
    flags stay what they are."""
    return jtu.tree_map(lambda v: jnp.asarray(v) if isinstance(v, float) else v, args)


def _can_enclose(flow: Flow, t0: jax.Array, x0: Tree) -> bool:
    try:
        jax.eval_shape(lambda t, x: flow.enclosure(constant(t), constant(x)), t0, x0)
    except NoEnclosure:
        return False
    return True
