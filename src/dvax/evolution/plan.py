"""The plan of a run: properties of the law that its code proves, and the solver of the law."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._jax.jaxprs import has_loop
from ..programs.enclosure import constant, has_enclosure
from ..sets._face import is_polyhedral
from ..vi import AbstractSolver, Auto, analyse, independent
from .flow import Flow, Rate, slope
from .implicit import Implicit
from .law_tolerance import law_tolerance
from .linearised import NoJacobian
from .method import AbstractMethod
from .moving_set import has_bounded_motion
from .setup import Setup
from .small_box import AbstractSmallBox, is_small, small_box

_MODULI = {"gamma", "L_F", "norm_P_inv", "law_gain"}
"""Moduli by which the response between two ends of a step is enclosed."""


class Plan(NamedTuple):
    """The way in which a run solves its law: static, made once per run, and stored in its `Solution`.

    - `closed_form`: the law is F(y) = ay − h(t, x, 0), so that y = proj_K(h(t, x, 0)/a);
    - `one_slope`: a is one number for each part, which saves memory traffic;
    - `constant_slope`: a does not depend on t and x;
    - `small_box`: the law is affine on a box of a few unknowns, its matrix does not depend on t and x,
      and a formula solves it;
    - `iterates`: the law, or the projection of its closed form, is computed by a loop;
    - `solver`: the solver of the law that `dvax.vi.Auto` chose, None if the user gave one;
    - `enclosed`: f̃ has an enclosure over a whole step, so that the defect is not sampled;
    - `interpolated`: this enclosure is made from the responses at the ends of the step.
    """

    closed_form: bool
    one_slope: bool
    constant_slope: bool
    small_box: bool
    iterates: bool
    solver: AbstractSolver | None
    enclosed: bool
    interpolated: bool

    @staticmethod
    def of(setup: Setup) -> "Plan":
        """Return the plan from the code of f, h and K, traced at the start of the run."""
        plan = Plan._of_law(setup)
        if isinstance(setup.method, Implicit) or setup.method.degree > 1:
            return plan
        at_ends = plan._replace(interpolated=True)
        ways = [plan, at_ends] if plan.closed_form else [at_ends]
        enclosed = next((way for way in ways if _is_enclosed(setup, way)), None)
        return plan if enclosed is None else enclosed._replace(enclosed=True)

    @staticmethod
    def _of_law(setup: Setup) -> "Plan":
        """Return the plan without an enclosure."""
        problem, x0, t0 = setup.problem, setup.x0, setup.number("t0")
        args = _tree.as_arrays(setup.args)
        like = problem.zero_control(x0)
        if not isinstance(setup.vi_solver, Auto):
            return Plan(False, False, False, False, True, None, False, False)
        K, frozen = problem.set_at(t0, args), problem.frozen(t0, x0, args)
        structure, is_box = analyse(frozen, like), K.intervals(like) is not None
        solver = setup.vi_solver.choose(frozen, K, like)
        intervals = structure.pointwise and structure.affine and is_box
        if not intervals and (not structure.isotropic or isinstance(like, tuple)):
            jacobian = lambda t, x: jax.jacfwd(problem.frozen(t, x, args))(like)  # noqa: E731
            affine = structure.affine and is_box and is_small(like)
            solved_by_formula = affine and independent(jacobian, t0, x0)
            iterates = not solved_by_formula
            return Plan(False, False, False, solved_by_formula, iterates, solver, False, False)
        operator = problem.operator(args)
        constant_slope = independent(lambda t, x: slope(problem, operator, t, x, args), t0, x0)
        project = lambda z: K.project(z, problem.spaces(x0)[1])  # noqa: E731
        iterates = not is_box and has_loop(jax.make_jaxpr(project)(like))
        return Plan(
            True, structure.isotropic, constant_slope, False, iterates, solver, False, False
        )

    def flow(self, setup: Setup) -> Flow:
        """Return the reduced map f̃ for the numbers of this call."""
        problem, x0, t0 = setup.problem, setup.x0, setup.number("t0")
        args = _tree.as_arrays(setup.args)
        operator, generator, method = problem.operator(args), problem.generator(args), setup.method
        reciprocal = None
        if self.closed_form and self.constant_slope:
            reciprocal = jtu.tree_map(jnp.reciprocal, slope(problem, operator, t0, x0, args))
            if self.one_slope:
                reciprocal = jtu.tree_map(lambda leaf: leaf.ravel()[0], reciprocal)
        explicit = isinstance(method, AbstractMethod) and method.explicit_in_A
        return Flow(
            problem=problem,
            args=args,
            generator=generator,
            operator=operator,
            solver=setup.vi_solver if self.solver is None else self.solver,
            direct=self.closed_form or self.small_box,
            iterates=self.iterates,
            reciprocal=reciprocal,
            enclosed=self.enclosed,
            interpolated=self.interpolated,
            tol=law_tolerance(setup),
            gamma=setup.moduli.get("gamma"),
            L_F=setup.moduli.get("L_F"),
            norm_P_inv=setup.moduli.get("norm_P_inv"),
            small_box=_small_box(setup) if self.small_box else None,
            linear=NoJacobian(generator) if explicit else None,
        )


def _is_enclosed(setup: Setup, plan: Plan) -> bool:
    """Return whether f̃ has an enclosure over a step in the way of a plan: its operations have rules,
    the motion of K has a bound, and the moduli of an interpolated response are known."""
    problem, x0, t0 = setup.problem, setup.x0, setup.number("t0")
    if plan.interpolated and not _MODULI <= set(setup.moduli):
        return False
    args, like = _tree.as_arrays(setup.args), problem.zero_control(x0)
    K = problem.set_at(t0, args)
    is_box = K.intervals(like) is not None
    # Without moduli nothing is certified, and a defect that is sampled allows longer steps.
    if not is_box and not setup.moduli:
        return False
    if plan.closed_form and plan.interpolated != (not is_box and is_polyhedral(K)):
        return False
    if not has_bounded_motion(problem, args, t0, like, problem.spaces(x0)[1]):
        return False
    zero = jnp.zeros((), _tree.dtype(x0))
    rate = Rate(x0, like, like, zero, zero > 0, jnp.asarray(0))
    flow = plan.flow(setup)
    enclosure = lambda t, x: flow.enclosure(constant(t), constant(x), rate, rate)  # noqa: E731
    return has_enclosure(enclosure, t0, x0)


def _small_box(setup: Setup) -> AbstractSmallBox:
    """Return the formula of an affine law on a box of a few unknowns."""
    problem, x0, args, t0 = setup.problem, setup.x0, _tree.as_arrays(setup.args), setup.number("t0")
    like = problem.zero_control(x0)
    assert isinstance(like, jax.Array)
    frozen = problem.frozen(t0, x0, args)
    M = jax.jacfwd(lambda v: frozen(v.reshape(like.shape)).ravel())(jnp.zeros_like(like).ravel())
    return small_box(M)
