"""The coupled system: A, P, K, f and h together."""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from . import _tree
from ._switches import switching_times
from ._tree import Tree
from .errors import InputError, InputProblem
from .generators import AbstractGenerator
from .operators import AbstractOperator
from .sets import AbstractSet
from .signals import listen
from .spaces import AbstractSpace
from .vi import AbstractSolver, Answer, Auto, Frozen, default_space

KNOT_ULPS, END_ULPS = 4, 128
"""Knots nearer than this to each other, or to the ends of a run, in roundings of t, are one: records
round the same moment differently."""


class Problem(eqx.Module):
    """A coupled nonsmooth dynamical system (paper, Problem 1).

        x(t) = e^{At} x₀ + ∫₀ᵗ e^{A(t−s)} f(s, x(s), u(s)) ds        (eq:state_mild)
        u(t) ∈ h(t, x(t), u(t)) − N_{K(t)}(P u(t))                   (eq:inclusion)

    With y = P u the law is VI(K(t), F), F(y) = P⁻¹y − h(t, x, P⁻¹y) (eq:F_def). Where F is strongly
    pseudomonotone and Lipschitz it has one solution u_x(t), and the system is x' = Ax + f̃(t, x).

    **Arguments:**

    - `A`: a `dvax.generators` object, or a callable `args -> generator`;
    - `P`: a `dvax.operators` object, or a callable `args -> operator`;
    - `K`: a `dvax.sets` object, or a callable `(t, args) -> set`;
    - `f(t, x, u, args)`, `h(t, x, u, args)`: traceable by JAX; x and u are arrays, or tuples of
      them;
    - `state_space`, `control_space`: where they are not plain Euclidean, or where u does not have
      the shape of x. The control space defaults to the state space.

    `args` is the paper's parameter η: any pytree, handed to all of them.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0),
    ...     P=dvax.operators.Scaling(1.0),
    ...     K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> float(problem.response(0.0, 0.1))
    0.4

    ```
    """

    A: AbstractGenerator | Callable[[Any], AbstractGenerator]
    P: AbstractOperator | Callable[[Any], AbstractOperator]
    K: AbstractSet | Callable[[Any, Any], AbstractSet]
    f: Callable[[Any, Tree, Tree, Any], Tree]
    h: Callable[[Any, Tree, Tree, Any], Tree]
    state_space: AbstractSpace | None = None
    control_space: AbstractSpace | None = None

    def __check_init__(self) -> None:
        wrong = [
            InputProblem(
                f"dvax.Problem({name})",
                f"{type(value).__name__} {value!r}",
                f"it must be {what}, or a callable of {arguments} that returns one",
                f"See dvax.{module}",
            )
            for name, value, kind, what, arguments, module in (
                ("A", self.A, AbstractGenerator, "a generator", "args", "generators"),
                ("P", self.P, AbstractOperator, "an operator", "args", "operators"),
                ("K", self.K, AbstractSet, "a set", "(t, args)", "sets"),
            )
            if not isinstance(value, kind) and not callable(value)
        ]
        wrong += [
            InputProblem(
                f"dvax.Problem({name})",
                repr(fn),
                "it must be callable as (t, x, u, args)",
                f"Wrap the value: {name}=lambda t, x, u, args: ...",
            )
            for name, fn in (("f", self.f), ("h", self.h))
            if not callable(fn)
        ]
        if wrong:
            raise InputError(*wrong)

    def generator(self, args: Any = None) -> AbstractGenerator:
        """A for these args."""
        return self.A if isinstance(self.A, AbstractGenerator) else self.A(args)

    def operator(self, args: Any = None) -> AbstractOperator:
        """P for these args."""
        return self.P if isinstance(self.P, AbstractOperator) else self.P(args)

    def set_at(self, t: Any, args: Any = None) -> AbstractSet:
        """K(t) for these args."""
        return self.K if isinstance(self.K, AbstractSet) else self.K(t, args)

    def spaces(self, x: Tree) -> tuple[AbstractSpace, AbstractSpace]:
        """The state and the control space, for states shaped like x."""
        state = default_space(x) if self.state_space is None else self.state_space
        return state, state if self.control_space is None else self.control_space

    def frozen(self, t: Any, x: Tree, args: Any = None) -> Callable[[Tree], Tree]:
        """The frozen operator F_{t,x}(y) = P⁻¹y − h(t, x, P⁻¹y) (paper, eq:F_def)."""
        P = self.operator(args)

        def F(y: Tree) -> Tree:
            u = P.inverse(y)
            return _tree.sub(u, self.h(t, x, u, args))

        return F

    def law(
        self,
        t: Any,
        x: Tree,
        args: Any = None,
        *,
        solver: AbstractSolver | None = None,
        y0: Tree | None = None,
        tol: Any = 1e-10,
        gamma: Any = None,
        L_F: Any = None,
    ) -> Answer:
        """Solve the frozen law for y = P u_x(t), from the guess y0 (zero by default)."""
        space = self.spaces(x)[1]
        guess = self.zero_control(x) if y0 is None else y0
        vi = Frozen(self.frozen(t, x, args), self.set_at(t, args), space, gamma, L_F)
        return (Auto() if solver is None else solver).solve(vi, guess, tol)

    def response(
        self, t: Any, x: Tree, args: Any = None, *, solver: AbstractSolver | None = None
    ) -> Tree:
        """The state-to-control map u_x(t) (paper, lem:unique_u), solved to 1e-10 in residual."""
        x = _tree.as_float(x, "x")
        self.check(t, x, args)
        return self.operator(args).inverse(self.law(t, x, args, solver=solver).y)

    def reduced(
        self, t: Any, x: Tree, args: Any = None, *, solver: AbstractSolver | None = None
    ) -> Tree:
        """The reduced map f̃(t, x) = f(t, x, u_x(t)) (paper, eq. reduced)."""
        return self.f(t, x, self.response(t, x, args, solver=solver), args)

    def check(self, t: Any, x: Tree, args: Any = None) -> None:
        """Raise an `InputError` with everything that does not fit: spaces, shapes, P, K."""
        state, control = self.spaces(x)
        state.check(x, "x0")
        u = self.zero_control(x)
        problems: list[InputProblem] = []
        for attempt in (
            lambda: self.generator(args).check(state),
            lambda: self.operator(args).check(control),
            lambda: self.set_at(t, args).check(u),
        ):
            try:
                attempt()
            except InputError as error:
                problems += error.problems
        for name, fn, element, space in (("f", self.f, x, "state"), ("h", self.h, u, "control")):
            out = jax.eval_shape(lambda t, x, u, fn=fn: fn(t, x, u, args), t, x, u)
            if not _tree.same_shape(out, element):
                problems.append(
                    InputProblem(
                        f"dvax.Problem({name})",
                        f"a value of shape {_tree.shapes(out)}",
                        f"{name}(t, x, u, args) must lie in the {space} space, whose elements have "
                        f"shape {_tree.shapes(element)}",
                        f"Return that shape from {name}, or name the spaces: state_space=, "
                        "control_space= of dvax.Problem",
                    )
                )
        if problems:
            raise InputError(*problems)

    def knots(self, t0: Any, t1: Any, x: Tree, args: Any = None) -> Any:
        """The times in (t0, t1) where the data in f, h or K is not smooth, sorted: the knots of their
        signals, and the times at which their code compares an affine function of t (`t < a`).

        **Raises:** `dvax.InputError` where some data does not cover [t0, t1].
        """
        u = self.zero_control(x)

        def listener(t: Any, x: Tree, u: Tree) -> list[Any]:
            with listen(t) as heard:
                self.set_at(t, args)
                self.f(t, x, u, args), self.h(t, x, u, args)
            found.append(heard)
            # Knots that are computed from args leave this trace as outputs.
            return [knots for knots in heard.knots if not _tree.is_concrete(knots)]

        found: list[Any] = []
        time = jnp.asarray(t0, jnp.result_type(float))
        switches = switching_times(listener, time, x, u)
        heard = found[-1]
        for name in sorted(set(heard.elsewhere)):
            warnings.warn(
                f"{name} is evaluated at a time other than t itself (shifted, scaled, or inside "
                "another jit), so its knots in t are unknown and a step may jump over one. Shift "
                "its times instead, or wrap it as dvax.signals.Function(fn, knots=...).",
                stacklevel=4,
            )
        _check_spans(heard.spans, t0, t1)
        listed = [*filter(_tree.is_concrete, heard.knots), *switches]
        if not listed:
            return np.zeros(0)
        concrete = _tree.is_concrete(listed, t0, t1)
        lib = np if concrete else jnp
        # Known ones are sorted here: the compiler takes a second for a thousand.
        of_knots = np if _tree.is_concrete(listed) else jnp
        arrays = [of_knots.asarray(knots, dtype=float) for knots in listed]
        if of_knots is np:
            arrays = [knots[np.isfinite(knots)] for knots in arrays]
        every = lib.asarray(of_knots.sort(of_knots.concatenate(arrays)))
        ulp = jnp.finfo(every.dtype).eps
        margin = END_ULPS * ulp * lib.maximum(lib.abs(t0), lib.abs(t1))
        apart = lib.diff(every, prepend=every[:1] - 1.0) > KNOT_ULPS * ulp * lib.abs(every)
        kept = apart & (every > t0 + margin) & (every < t1 - margin)
        if concrete:
            return every[kept]
        # Traced knots cannot be dropped, so the others become the end, where a step ends anyway.
        return jnp.sort(jnp.where(kept, every, t1))

    def zero_control(self, x: Tree) -> Tree:
        """The zero of the control space, in the floating type of x."""
        if self.control_space is None:
            return _tree.zeros_like(x)
        dtype = jnp.result_type(*jax.tree_util.tree_leaves(x))
        return jax.tree_util.tree_map(lambda leaf: leaf.astype(dtype), self.control_space.zeros())


def _check_spans(spans: list[tuple[Any, Any, str]], t0: Any, t1: Any) -> None:
    if not _tree.is_concrete(spans, t0, t1):
        return
    short = [
        InputProblem(
            f"a {name} in f, h or K",
            f"data from t = {float(first):g} to {float(last):g}",
            f"it must cover [t0, t1] = [{float(t0):g}, {float(t1):g}]: data is never extrapolated",
            "Shorten the time span, or extend the data",
        )
        for first, last, name in spans
        if float(first) > float(t0) or float(last) < float(t1)
    ]
    if short:
        raise InputError(*short)
