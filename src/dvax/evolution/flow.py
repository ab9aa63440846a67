"""The reduced map f̃ along a trajectory, with the quantities of the law that a step needs."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..generators import AbstractGenerator, AbstractPropagator, Dense, Diagonal, Scalar
from ..generators.spectral_state import expand_state
from ..operators import AbstractOperator, Scaling
from ..operators import Diagonal as DiagonalOperator
from ..problem import Problem
from ..programs.enclosure import (
    LinearEnclosure,
    NoEnclosure,
    enclose,
    is_enclosure,
    largest,
    smallest,
)
from ..programs.partial_evaluation import PartialEvaluation
from ..programs.structure import analyse
from ..sets import AbstractSet, Polyhedron
from ..sets._face import face
from ..sets._library import is_of_library
from ..spaces import AbstractSpace
from ..vi import RESULTS, AbstractSolver, FrozenVI
from ..vi.known import Known
from .enclosed_projection import by_its_rules, part
from .interpolated_response import Place, interpolated, interpolated_projection
from .law_tolerance import LawTolerance
from .linearised import AbstractLinear, finite, linearise
from .moving_set import motion
from .small_box import AbstractSmallBox

_SMALL = 400
"""Entries of A, up to which one more operation costs more than its arithmetic."""


class Rate(NamedTuple):
    """f̃(t, x) and the law behind it.

    `value` = f(t, x, u); y = P u; `z`, whose projection onto K is y (both None where not kept);
    `residual` = ‖w‖ of the frozen solve; `solved`, whether it met its tolerance; `evaluations` of F;
    `switches`, the switch functions of K at z, where the flow keeps them (`Flow.keeps_switches`);
    `place`, what an `interpolated` flow needs of the ends of a step.
    """

    value: Tree
    y: Tree | None
    z: Tree | None
    residual: jax.Array
    solved: jax.Array
    evaluations: jax.Array
    switches: list[jax.Array] | None = None
    place: Place | None = None


class EnclosedRate(NamedTuple):
    """Enclosures over a step: of f(t, x, u) in `value`, of a line or of the response in `u`; and bounds
    on the distance of the response from this u: `law_residual`/γ for y, `apart` for u, and the `effect`
    on f̃, without roundoff (0 if u is the response)."""

    value: Tree
    u: Tree
    law_residual: jax.Array
    apart: jax.Array
    effect: jax.Array


class Flow(eqx.Module):
    """x' = Ax + f̃(t, x) for one `args`, with the law's solver and tolerance settled.

    `direct` says that the law has a closed form, so that no guess is needed: it was proved to be
    F(y) = ay − h(t, x, 0), pointwise on a set of pointwise intervals, or with one number a on any set,
    and y = proj_K(h(t, x, 0)/a); or affine on a box of few unknowns, solved by the formula `small_box`.
    `iterates` says that the law, or the projection of its closed form, is computed by a loop. Such a
    program takes a compiler a second or ten for every place that contains it.
    `reciprocal` is 1/a where a was proved not to depend on t and x, so that it is computed once.
    `enclosed` says that f̃ has a linear enclosure over a whole step, so that nothing about the defect
    is guessed. If it is `interpolated`, this one is made from the responses at both ends of the step.
    `linear` is A + J where some J joins A in what is left to the propagator.
    With `keeps_switches`, `rate` also returns the switch functions of a law that `iterates`, so that
    they are compiled once with it and not wherever they are read. `pointwise` says
    that each entry of f̃ depends on t and on that entry of x alone. `prepared` is K, with what does not
    depend on t computed once (`prepare`).
    """

    problem: Problem
    args: Any
    generator: AbstractGenerator
    operator: AbstractOperator
    solver: AbstractSolver
    direct: bool = eqx.field(static=True)
    iterates: bool = eqx.field(static=True)
    reciprocal: Tree | None
    enclosed: bool = eqx.field(static=True)
    interpolated: bool = eqx.field(static=True)
    tol: LawTolerance
    gamma: Any
    L_F: Any
    norm_P_inv: Any
    small_box: AbstractSmallBox | None = None
    linear: AbstractLinear | None = None
    keeps_switches: bool = eqx.field(static=True, default=False)
    pointwise: bool = eqx.field(static=True, default=False)
    prepared: PartialEvaluation | None = None

    def prepare(self, t: Any, x: Tree) -> "Flow":
        """Return the flow that computes what does not depend on t of K(t) here, and not at each
        evaluation, if its law is computed by a loop."""
        if not self.iterates:
            return self
        like, space = self.problem.zero_control(x), self.problem.spaces(x)[1]
        known = True

        def K(t: Any) -> AbstractSet:
            nonlocal known
            K = self.problem.set_at(t, self.args)
            known = is_of_library(K)
            return K.prepared(like, space) if isinstance(K, Polyhedron) else K

        prepared = PartialEvaluation.of(K, t)
        return dataclasses.replace(self, prepared=prepared) if known else self

    def set_at(self, t: Any) -> AbstractSet:
        """Return K(t)."""
        return self.problem.set_at(t, self.args) if self.prepared is None else self.prepared(t)

    def propagator(self, h: Any, terms: int) -> AbstractPropagator:
        """The exact flow over h of x' = Ax + p, or of x' = (A + J)x + p."""
        linear = self.generator if self.linear is None else self.linear
        return linear.propagator(h, terms)

    def propagators(self, lengths: tuple[Any, ...], terms: int) -> tuple[AbstractPropagator, ...]:
        """Those over several lengths."""
        linear = self.generator if self.linear is None else self.linear
        one = lambda h: linear.propagator(h, terms)  # noqa: E731
        size = sum(leaf.size for leaf in jtu.tree_leaves(eqx.filter(linear, eqx.is_array)))
        # The φ-functions of all of them in one go, where all that a propagator holds are those.
        if size > _SMALL or not isinstance(linear, Scalar | Diagonal | Dense | AbstractLinear):
            return tuple(map(one, lengths))
        stacked = jax.vmap(one)(jnp.stack(lengths))
        return tuple(jtu.tree_map(lambda leaf, k=k: leaf[k], stacked) for k in range(len(lengths)))

    def expand(self, x: Tree, known: Tree = None) -> Tree:
        """x as propagators take it with the least work."""
        return expand_state(self.generator, x, known) if self.linear is None else x

    def nonlinear_part(self, x: Tree, value: Tree) -> Tree:
        """f̃ without what is left to the propagator: `value` = f̃(t, x), or f̃(t, x) − Jx."""
        return value if self.linear is None else _tree.sub(value, self.linear.apply(x))

    def linearised(self, t: Any, x: Tree, guess: Tree | None) -> tuple["Flow", Tree]:
        """The flow with J = Df̃(t, x) left to the propagator, and ∂ₜf̃(t, x)."""
        value = lambda t, x: self.rate(t, x, guess).value  # noqa: E731
        _, push = jax.linearize(value, t, x)
        drift = finite(push(jnp.ones_like(t), _tree.zeros_like(x)))
        linear = linearise(self.generator, lambda v: push(jnp.zeros_like(t), v), x)
        return dataclasses.replace(self, linear=linear), drift

    def rate(self, t: Any, x: Tree, guess: Tree | None) -> Rate:
        """f̃(t, x), the law being solved from `guess`."""
        return _by_loop(self, t, x, guess) if self.iterates else self._closed_form(t, x)

    def with_known_response(self) -> "Flow":
        """The same, where `rate` is asked for derivatives alone and its guess solves the law: an
        iteration takes long to compile."""
        if self.direct or not self.iterates or not self.solver.certifies:
            return self
        return dataclasses.replace(self, solver=Known(), keeps_switches=False)

    def guess(self, x: Tree) -> Tree | None:
        """Where the law's solver starts when nothing is known; None where it needs no start."""
        return None if self.direct else self.problem.zero_control(x)

    def _closed_form(self, t: Any, x: Tree) -> Rate:
        problem, args = self.problem, self.args
        if self.small_box is not None:
            return self._by_formula(self.small_box, t, x)
        drive = problem.h(t, x, problem.zero_control(x), args)
        if self.reciprocal is not None:
            z = jtu.tree_map(jnp.multiply, drive, self.reciprocal)
            solved = _all_positive(self.reciprocal)
        else:
            a = slope(problem, self.operator, t, x, args)
            z = jtu.tree_map(jnp.divide, drive, a)
            solved = _all_positive(a)
        y = self.set_at(t).project(z, problem.spaces(x)[1])
        value = problem.f(t, x, self.operator.inverse(y), args)
        exact = jnp.zeros((), jnp.result_type(*jtu.tree_leaves(x)))
        # With a slope that is not positive the law is not monotone, and this is not its solution.
        return Rate(value, y, z, exact, solved, jnp.asarray(1))

    def _by_formula(self, small_box: AbstractSmallBox, t: Any, x: Tree) -> Rate:
        problem, args = self.problem, self.args
        zero = problem.zero_control(x)
        bounds = self.set_at(t).intervals(zero)
        assert bounds is not None
        q = problem.frozen(t, x, args)(zero)
        found = small_box.solve(q, *bounds)
        value = problem.f(t, x, self.operator.inverse(found.y), args)
        residual = problem.spaces(x)[1].norm(found.w)
        # Where nothing is found the law has no solution, or is not monotone.
        most = jnp.maximum(self.law_tol(t, x, zero), 1e3 * small_box.rounding(found.y, q))
        apart = jnp.abs(found.y - jnp.clip(found.z, *bounds)).ravel()
        solved = jnp.all((jnp.abs(found.w).ravel() <= most) & (apart <= most))
        return Rate(value, found.y, found.z, residual, solved, jnp.asarray(1))

    def law_tol(self, t: Any, x: Tree, y: Tree) -> jax.Array:
        """Return the tolerance of the law at (t, x), from the effect that a change of y has on f."""

        def effect(d: Tree) -> Tree:
            fn = lambda y: self.problem.f(t, x, self.operator.inverse(y), self.args)  # noqa: E731
            return jax.jvp(fn, (y,), (d,))[1]

        return self.tol(x, effect, y)

    def enclosure(
        self, t: LinearEnclosure, x: Tree, first: Rate | None, last: Rate | None
    ) -> EnclosedRate:
        """Return enclosures of f̃ and of the response over a step, given those of t and x, and the rates
        at its ends if the response is `interpolated`.

        **Raises:** `NoEnclosure` where f, h or K uses an operation without a rule.
        """
        problem, args = self.problem, self.args
        f = lambda t, x, u: problem.f(t, x, u, args)  # noqa: E731
        if self.direct and self.small_box is None and not self.interpolated:
            u = self._enclosed_response(t, x)
            zero = jnp.zeros_like(t.dev)
            return EnclosedRate(enclose(f, t, x, u), u, zero, zero, zero)
        places = self._places(t, x, first, last)
        # In the precision of the run, and no sharper than they are.
        dtype = t.a.dtype
        more = 1.0 + 4.0 * float(jnp.finfo(dtype).eps)
        gamma = jnp.asarray(self.gamma / more, dtype)
        L_F, norm_P_inv, gain = (
            jnp.asarray(v * more, dtype) for v in (self.L_F, self.norm_P_inv, self.tol.gain)
        )
        if self.direct and self.small_box is None:
            z, space = self._enclosed_point(t, x), problem.spaces(part(x, "a"))[1]
            moves = motion(problem, args, t, part(z, "a"), space)
            y, residual, resolved = interpolated_projection(
                self.set_at(t.a), space, z, places, moves.deviation
            )
            u = enclose(self.operator.inverse, y)
            residual, resolved = gamma * residual, gamma * resolved
        else:
            u, residual, resolved = interpolated(
                problem, args, self.operator, t, x, places, gamma, L_F
            )
        effects = norm_P_inv * residual / gamma, gain * resolved / gamma
        return EnclosedRate(enclose(f, t, x, u), u, residual, *effects)

    def _places(
        self, t: LinearEnclosure, x: Tree, first: Rate | None, last: Rate | None
    ) -> tuple[Place, Place]:
        assert first is not None and last is not None
        begin, end = (
            self.place(part(t, side), part(x, side), rate) if rate.place is None else rate.place
            for side, rate in (("a", first), ("b", last))
        )
        return begin, end

    def place(self, t: Any, x: Tree, rate: Rate) -> Place:
        """Return z of a closed form, or y − F(y)/L_F where the law is iterated, since solvers return
        other z; with its projection and the face of K there."""
        K, space = self.set_at(t), self.problem.spaces(x)[1]
        z = rate.z
        if not self.direct:
            F = self.problem.frozen(t, x, self.args)(rate.y)
            z = jtu.tree_map(lambda y, force: y - force / jnp.asarray(self.L_F, y.dtype), rate.y, F)
        found = face(K, z, space)
        y = K.project(z, space) if found is None else found.y
        return jax.lax.stop_gradient(Place(z, y, found))

    def _enclosed_point(self, t: LinearEnclosure, x: Tree) -> Tree:
        """Return the enclosure of z, whose projection is y, for a law in closed form."""
        if self.reciprocal is None:
            raise NoEnclosure("a slope of the law that moves")
        problem, args = self.problem, self.args
        zero = problem.zero_control(part(x, "a"))
        drive = enclose(lambda t, x: problem.h(t, x, zero, args), t, x)
        return enclose(lambda d: jtu.tree_map(jnp.multiply, d, self.reciprocal), drive)

    def _enclosed_response(self, t: LinearEnclosure, x: Tree) -> Tree:
        """Return the enclosure of the response of a law in closed form, by the rules of the
        projection."""
        problem, args, z = self.problem, self.args, self._enclosed_point(t, x)
        like, space = part(z, "a"), problem.spaces(part(x, "a"))[1]
        if self.set_at(t.a).intervals(like) is not None:
            ends = enclose(lambda t: problem.set_at(t, args).intervals(like), t)
            y = jtu.tree_map(
                lambda q, low, up: smallest(largest(q, low), up), z, *ends, is_leaf=is_enclosure
            )
        else:
            y = by_its_rules(problem, args, space, t, z, motion(problem, args, t, like, space))
        return enclose(self.operator.inverse, y)

    def switches_of(self, t: Any, x: Tree, rate: Rate) -> list[jax.Array] | None:
        """`switch_parts` at (t, x), whose rate this is."""
        return self.switch_parts(t, x, rate.z) if rate.switches is None else rate.switches

    def switch_parts(self, t: Any, x: Tree, z: Tree | None) -> list[jax.Array] | None:
        """What changes its sign where the response has a kink; None where K does not say."""
        return self.set_at(t).switches(z, self.problem.spaces(x)[1])

    def switches(self, t: Any, x: Tree, z: Tree | None) -> jax.Array | None:
        """`switch_parts` as one vector. This gathers what is sharded over several devices."""
        found = self.switch_parts(t, x, z)
        return None if found is None else joined(found, jnp.result_type(*jtu.tree_leaves(z)))

    def masked_error(self, t: Any, x: Tree, rate: Rate, error: Tree) -> Tree:
        """How far f̃ may be off, entry by entry, because z may be off by ± `error`.

        While u sits on the boundary of K, f̃ does not feel z at all, and an error estimate built from
        f̃ alone goes blind. What z could do is read off the projection: the part of
        proj(z ± e) − proj(z) that is not linear in e, which is zero deep inside K and deep outside it
        and large just where z might have crossed the boundary unseen.
        """
        K = self.set_at(t)
        space = self.problem.spaces(x)[1]
        P = self.operator
        project = lambda z: K.project(z, space)  # noqa: E731
        u = P.inverse(rate.y)

        zero = _tree.zeros_like(error)
        points = [rate.z, _tree.add(rate.z, error), _tree.sub(rate.z, error)]
        if not self.iterates:
            base, linear = jax.jvp(project, (rate.z,), (error,))
            above, below = map(project, points[1:])
        else:
            # One projection of a batch: a projection that iterates takes long to compile.
            stack = lambda *trees: jtu.tree_map(lambda *leaves: jnp.stack(leaves), *trees)  # noqa: E731
            values, tangents = jax.jvp(
                jax.vmap(project), (stack(*points),), (stack(error, zero, zero),)
            )
            row = lambda k, tree: jtu.tree_map(lambda leaf: leaf[k], tree)  # noqa: E731
            base, above, below, linear = *(row(k, values) for k in range(3)), row(0, tangents)

        def difference(sign: float, end: Tree) -> Tree:
            curved = _tree.sub(end, _tree.add(base, _tree.scale(sign, linear)))
            shifted = self.problem.f(t, x, _tree.add(u, P.inverse(curved)), self.args)
            return jtu.tree_map(lambda a, b: jnp.abs(a - b), shifted, rate.value)

        return jtu.tree_map(jnp.maximum, difference(1.0, above), difference(-1.0, below))

    def state_space(self, x: Tree) -> AbstractSpace:
        return self.problem.spaces(x)[0]


def joined(parts: list[jax.Array], dtype: Any) -> jax.Array:
    """Return arrays of any shapes as one vector."""
    return jnp.concatenate([jnp.zeros(0, dtype), *map(jnp.ravel, parts)])


@eqx.filter_jit
def _by_loop(flow: Flow, t: Any, x: Tree, guess: Tree | None) -> Rate:
    """The rate of a flow that iterates. A function of its own, so that it is traced once a program,
    however many places of a step ask for it."""
    rate = flow._closed_form(t, x) if flow.direct else _solved(flow, t, x, guess)
    switches = flow.switch_parts(t, x, rate.z) if flow.keeps_switches else None
    place = flow.place(t, x, rate) if flow.interpolated else None
    return rate._replace(switches=jax.lax.stop_gradient(switches), place=place)


def _solved(flow: Flow, t: Any, x: Tree, guess: Tree | None) -> Rate:
    problem, args = flow.problem, flow.args
    start = problem.zero_control(x) if guess is None else guess
    vi = FrozenVI(
        problem.frozen(t, x, args),
        flow.set_at(t),
        problem.spaces(x)[1],
        flow.gamma,
        flow.L_F,
        rtol=flow.tol.relative,
    )
    answer = flow.solver.solve(vi, start, flow.law_tol(t, x, start))
    value = problem.f(t, x, flow.operator.inverse(answer.y), args)
    solved = answer.result == RESULTS.successful
    return Rate(value, answer.y, answer.z, answer.residual, solved, answer.evaluations)


def is_pointwise(problem: Problem, operator: AbstractOperator, t: Any, x: Tree, args: Any) -> bool:
    """Return whether each entry of f̃(t, x) depends on t and on that entry of x alone."""
    like = problem.zero_control(x)
    if not (isinstance(x, jax.Array) and isinstance(like, jax.Array) and like.shape == x.shape):
        return False
    if not isinstance(operator, Scaling | DiagonalOperator):
        return False
    K = problem.set_at(t, args)
    if jax.eval_shape(K.intervals, like) is None:
        return False
    return all(
        analyse(lambda v, fn=function: fn(t, v, v, args), x).pointwise
        for function in (problem.f, problem.h)
    )


def slope(problem: Problem, operator: AbstractOperator, t: Any, x: Tree, args: Any) -> Tree:
    """a with F(y) = ay + const, for a law that is pointwise affine: a = P⁻¹1 − ∂ᵤh P⁻¹1."""
    zero = problem.zero_control(x)
    ones = operator.inverse(jtu.tree_map(jnp.ones_like, zero))
    _, change = jax.jvp(lambda u: problem.h(t, x, u, args), (zero,), (ones,))
    return _tree.sub(ones, change)


def _all_positive(tree: Tree) -> jax.Array:
    smallest_entry = jnp.stack([jnp.min(leaf) for leaf in jtu.tree_leaves(tree)])
    return jnp.all((smallest_entry > 0) & jnp.isfinite(smallest_entry))
