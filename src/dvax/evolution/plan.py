"""The plan of a run: properties of the law that its code proves, and the solver of the law."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._jax.jaxprs import has_loop
from ..programs.enclosure import constant, has_enclosure
from ..vi import AbstractSolver, Auto, analyse, independent
from .flow import Flow, slope
from .implicit import Implicit
from .law_tolerance import law_tolerance
from .linearised import NoJacobian
from .method import AbstractMethod
from .setup import Setup
from .small_box import AbstractSmallBox, is_small, small_box


class Plan(NamedTuple):
    """The way in which a run solves its law: static, made once per run, and stored in its `Solution`.

    - `closed_form`: the law is F(y) = ay − h(t, x, 0), so that y = proj_K(h(t, x, 0)/a);
    - `one_slope`: a is one number for each part, which saves memory traffic;
    - `constant_slope`: a does not depend on t and x;
    - `small_box`: the law is affine on a box of a few unknowns, its matrix does not depend on t and x,
      and a formula solves it;
    - `iterates`: the law, or the projection of its closed form, is computed by a loop;
    - `solver`: the solver of the law that `dvax.vi.Auto` chose, None if the user gave one;
    - `enclosed`: f̃ has an enclosure over a whole step, so that the defect is not sampled.
    """

    closed_form: bool
    one_slope: bool
    constant_slope: bool
    small_box: bool
    iterates: bool
    solver: AbstractSolver | None
    enclosed: bool

    @staticmethod
    def of(setup: Setup) -> "Plan":
        """Return the plan from the code of f, h and K, traced at the start of the run."""
        problem, x0, t0 = setup.problem, setup.x0, setup.number("t0")
        args = _tree.as_arrays(setup.args)
        like = problem.zero_control(x0)
        if not isinstance(setup.vi_solver, Auto):
            return Plan(False, False, False, False, True, None, False)
        K, frozen = problem.set_at(t0, args), problem.frozen(t0, x0, args)
        structure, is_box = analyse(frozen, like), K.intervals(like) is not None
        solver = setup.vi_solver.choose(frozen, K, like)
        intervals = structure.pointwise and structure.affine and is_box
        if not intervals and (not structure.isotropic or isinstance(like, tuple)):
            jacobian = lambda t, x: jax.jacfwd(problem.frozen(t, x, args))(like)  # noqa: E731
            affine = structure.affine and is_box and is_small(like)
            solved_by_formula = affine and independent(jacobian, t0, x0)
            return Plan(
                False, False, False, solved_by_formula, not solved_by_formula, solver, False
            )
        operator = problem.operator(args)
        constant_slope = independent(lambda t, x: slope(problem, operator, t, x, args), t0, x0)
        project = lambda z: K.project(z, problem.spaces(x0)[1])  # noqa: E731
        iterates = not is_box and has_loop(jax.make_jaxpr(project)(like))
        plan = Plan(True, structure.isotropic, constant_slope, False, iterates, solver, False)
        line = not isinstance(setup.method, Implicit) and setup.method.degree <= 1
        if not (intervals and line):
            return plan
        flow = plan.flow(setup)
        enclosed = has_enclosure(lambda t, x: flow.enclosure(constant(t), constant(x)), t0, x0)
        return plan._replace(enclosed=enclosed)

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
            tol=law_tolerance(setup),
            gamma=setup.moduli.get("gamma"),
            L_F=setup.moduli.get("L_F"),
            small_box=_small_box(setup) if self.small_box else None,
            linear=NoJacobian(generator) if explicit else None,
        )


def _small_box(setup: Setup) -> AbstractSmallBox:
    """Return the formula of an affine law on a box of a few unknowns."""
    problem, x0, args, t0 = setup.problem, setup.x0, _tree.as_arrays(setup.args), setup.number("t0")
    like = problem.zero_control(x0)
    assert isinstance(like, jax.Array)
    frozen = problem.frozen(t0, x0, args)
    M = jax.jacfwd(lambda v: frozen(v.reshape(like.shape)).ravel())(jnp.zeros_like(like).ravel())
    return small_box(M)
