"""The coupled problem of A, P, K, f and h."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from . import _control_shape, _knots, _tree, _user_code
from ._captured import current
from ._jax import outlined
from ._once import once_per_object
from ._tree import Tree
from .errors import InputError, InputProblem, Problems, input_error
from .generators import AbstractGenerator
from .operators import AbstractOperator
from .programs.indices import index_outside
from .programs.switching_times import switching_times
from .sets import AbstractSet
from .signals import listen
from .spaces import AbstractSpace
from .vi import AbstractSolver, Answer, Auto, FrozenVI, analyse, default_space
from .vi.arguments import solver_problems
from .vi.outcome import raise_failure, unless_failed


@dataclass(frozen=True, eq=False)
class FrozenOperator:
    """F(y) = P⁻¹y − h(t, x, P⁻¹y), with its parts as fields for specialised solvers."""

    P: AbstractOperator
    h: Callable[[Any, Tree, Tree, Any], Tree]
    t: Any
    x: Tree
    args: Any

    def __call__(self, y: Tree) -> Tree:
        u = self.P.inverse(y)
        return _tree.sub(u, self.h(self.t, self.x, u, self.args))

    def inverse_up_to_a_factor(self, like: Tree) -> Callable[[Tree], Tree] | None:
        """Return P if the code of h shows that ∂h/∂u is one number b, so that F′ = (1 − b)P⁻¹, which is
        self-adjoint; None otherwise."""
        if isinstance(like, tuple):
            return None
        law = analyse(lambda u: u - self.h(self.t, self.x, u, self.args), like)
        return self.P.apply if law.isotropic else None


class Knots(NamedTuple):
    """The knots of data, as vectors of times, and the intervals that the data cover."""

    listed: list[Any]
    spans: list[tuple[Any, Any, str, str]]

    def within(self, t0: Any, t1: Any) -> Any:
        """Return the sorted knots in (t0, t1).

        **Raises:** `dvax.InputError` if some data do not cover [t0, t1].
        """
        _check_spans(self.spans, t0, t1)
        return _knots.merge(self.listed, t0, t1) if self.listed else np.zeros(0)

    def near_end(self, t0: Any, t1: Any) -> Any:
        """Return the first knot that `within` leaves out since it is close to an end; infinity without
        one."""
        return _knots.near_end(self.listed, t0, t1)


class Problem(eqx.Module):
    """A coupled nonsmooth dynamical system (paper, Problem 1).

        x(t) = e^{At} x₀ + ∫₀ᵗ e^{A(t−s)} f(s, x(s), u(s)) ds        (eq:state_mild)
        u(t) ∈ h(t, x(t), u(t)) − N_{K(t)}(P u(t))                   (eq:inclusion)

    With y = P u the law is VI(K(t), F), F(y) = P⁻¹y − h(t, x, P⁻¹y) (eq:F_def). If F is strongly
    pseudomonotone and Lipschitz it has a unique solution u_x(t), and the system is x' = Ax + f̃(t, x).

    **Arguments:**

    - `A`: a `dvax.generators` object, or a callable `args -> generator`;
    - `P`: a `dvax.operators` object, or a callable `args -> operator`;
    - `K`: a `dvax.sets` object, or a callable `(t, args) -> set`;
    - `f(t, x, u, args)`, `h(t, x, u, args)`: traceable by JAX; x and u are arrays, or tuples of
      arrays;
    - `state_space`, `control_space`: needed if they are not Euclidean. u has the shape that P and K
      determine (by a matrix, or vectors of bounds; not by a callable), else that of x, and is then in
      the state space, with its weights: K is projected onto in their norm. Pass the control space if u
      has another shape or other weights, such as `control_space=dvax.spaces.Euclidean(())` for a number
      u and a vector x.

    `args` is the parameter η of the paper: any pytree, which is passed to all of these. Other values
    that f, h, K, A and P read (globals, closures, attributes of objects) may change between two calls,
    each of which then compiles a program again: pass numbers that change in `args`.

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
        wrong = Problems(
            InputProblem(
                f"dvax.Problem({name})",
                " ".join(f"{type(value).__name__} {value!r}".split())[:200],
                f"it must be {what}, or a callable of {arguments} that returns one",
                f"See dvax.{module}, for example {module}.{example}",
            )
            for name, value, kind, what, arguments, module, example in (
                ("A", self.A, AbstractGenerator, "a generator", "args", "generators", "Dense(M)"),
                ("P", self.P, AbstractOperator, "an operator", "args", "operators", "Scaling(1.0)"),
                ("K", self.K, AbstractSet, "a set", "(t, args)", "sets", "Box(lower, upper)"),
            )
            if not isinstance(value, kind)
            and (not callable(value) or (isinstance(value, type) and issubclass(value, kind)))
        )
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
        wrong += [
            InputProblem(
                f"dvax.Problem({name})",
                repr(space),
                "it must be a space, or None",
                f"Write {name}=dvax.spaces.Euclidean(3) for vectors of 3",
            )
            for name, space in (
                ("state_space", self.state_space),
                ("control_space", self.control_space),
            )
            if not isinstance(space, AbstractSpace | None)
        ]
        wrong.raise_any()

    def generator(self, args: Any = None) -> AbstractGenerator:
        """Return A for these args."""
        return self.A if isinstance(self.A, AbstractGenerator) else self.A(args)

    def operator(self, args: Any = None) -> AbstractOperator:
        """Return P for these args."""
        return self.P if isinstance(self.P, AbstractOperator) else self.P(args)

    def set_at(self, t: Any, args: Any = None) -> AbstractSet:
        """Return K(t) for these args."""
        return self.K if isinstance(self.K, AbstractSet) else self.K(t, args)

    def spaces(self, x: Tree) -> tuple[AbstractSpace, AbstractSpace]:
        """Return the state space and the control space, for states shaped like x."""
        state = default_space(x) if self.state_space is None else self.state_space
        if self.control_space is not None:
            return state, self.control_space
        zero = _control_zero(self, x)
        return state, state if zero is None else default_space(zero)

    def frozen(self, t: Any, x: Tree, args: Any = None) -> "FrozenOperator":
        """Return the frozen operator F_{t,x}(y) = P⁻¹y − h(t, x, P⁻¹y) (paper, eq:F_def)."""
        return FrozenOperator(self.operator(args), self.h, t, x, args)

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
        """Solve the frozen law for y = P u_x(t), from the guess y0 (default 0)."""
        return self._law(t, x, args, solver, y0, tol, gamma, L_F)[1]

    def _law(
        self, t: Any, x: Tree, args: Any, solver: Any, y0: Any = None, tol: Any = 1e-10,
        gamma: Any = None, L_F: Any = None,
    ) -> tuple[FrozenVI, Answer]:  # fmt: skip
        if wrong := solver_problems("solver", solver):
            raise InputError(*wrong)
        space = self.spaces(x)[1]
        guess = self.zero_control(x) if y0 is None else y0
        vi = FrozenVI(self.frozen(t, x, args), self.set_at(t, args), space, gamma, L_F)
        return vi, (Auto() if solver is None else solver).solve(vi, guess, tol)

    def response(
        self, t: Any, x: Tree, args: Any = None, *, solver: AbstractSolver | None = None
    ) -> Tree:
        """Return the state-to-control map u_x(t) (paper, lem:unique_u).

        The residual is at most 1e-10, or the roundoff. The first call compiles; later calls with the
        same functions and shapes reuse the program. Pass values that change in `args`: a number that
        f, h, A, P or K reads from around it makes another program when it changes.

        **Raises:** `dvax.SolveError` if the solver fails. If the failure is traced (`jax.jit`,
        `jax.vmap`), values and derivatives are NaN instead.
        """
        return self._solve_law(t, x, args, solver, of_rate=False)

    def reduced(
        self, t: Any, x: Tree, args: Any = None, *, solver: AbstractSolver | None = None
    ) -> Tree:
        """Return the reduced map f̃(t, x) = f(t, x, u_x(t)) (paper, eq. reduced).

        Raises the errors of `response`."""
        return self._solve_law(t, x, args, solver, of_rate=True)

    def _solve_law(self, t: Any, x: Tree, args: Any, solver: Any, of_rate: bool) -> Tree:
        """Return u_x(t), or f̃(t, x) if `of_rate`, after checking the input and the solution of the
        law."""
        self = current(self)
        x, t = _tree.as_float(x, "x"), _tree.as_float(t, "t")
        for name, value in (("t", t), ("x", x)):
            _tree.check_not_nan(name, value)
        _user_code.check_args(args, "dvax.Problem.response")
        self.check(t, x, args)
        if wrong := solver_problems("solver", solver):
            raise InputError(*wrong)
        # Without this a number would be a static argument, and a new one compile a new program.
        args = _tree.as_arrays(args)
        out, solved, answer = _solve_compiled(self, t, x, args, solver, of_rate)
        raise_failure(solved, answer, solver)
        return out

    def check(self, t: Any, x: Tree, args: Any = None) -> None:
        """Raise an `InputError` with all problems of parameters, spaces, shapes, A, P and K."""
        state, control = self.spaces(x)
        state.check(x, "x0")
        u = self.zero_control(x)
        problems = Problems()
        for attempt in (
            lambda: self._check_map("A", self.A, args, AbstractGenerator, x, state),
            lambda: self._check_map("P", self.P, args, AbstractOperator, x, control),
            lambda: self._check_set(t, x, u, args),
            lambda: self._check_values("f", self.f, (t, x, u, args), x, "state"),
            lambda: self._check_values("h", self.h, (t, x, u, args), u, "control"),
        ):
            with problems.collect():
                attempt()
        if (
            problems
            and isinstance(x, tuple)
            and not any(isinstance(v, tuple) or jnp.ndim(v) for v in x)
        ):
            problems.insert(0, _tuple_of_numbers(x))
        problems.raise_any()

    def _evaluate(self, name: str, value: Any, inputs: dict[str, Any], kind: type, x: Tree) -> Any:
        """Return A, P or K, called with its arguments if it is a callable, after checking its type."""
        if not isinstance(value, kind):
            value = _user_code.call(name, value, inputs)
            if not isinstance(value, kind):
                raise input_error(
                    f"dvax.Problem({name})",
                    f"a callable that returns {type(value).__name__} {value!r}"[:200],
                    f"{name}({', '.join(inputs)}) must return an instance of dvax."
                    f"{kind.__module__.split('.')[1]}.{kind.__name__}",
                    f"See dvax.{kind.__module__.split('.')[1]}",
                )
        _user_code.check_precision(name, value, x)
        return value

    def _check_map(
        self, name: str, value: Any, args: Any, kind: type, x: Tree, space: AbstractSpace
    ) -> None:
        def at(args: Any) -> Any:
            return self._evaluate(name, value, {"args": args}, kind, x)

        if not isinstance(value, kind):
            _check_indices(name, value, at, args)
        at(args).check(space)

    def _check_set(self, t: Any, x: Tree, u: Tree, args: Any) -> None:
        def at(t: Any, args: Any) -> AbstractSet:
            return self._evaluate("K", self.K, {"t": t, "args": args}, AbstractSet, x)

        if not isinstance(self.K, AbstractSet):
            _check_indices("K", self.K, at, t, args)
        at(t, args).check(u)

    def _check_values(
        self, name: str, fn: Callable[..., Any], inputs: tuple, element: Tree, space: str
    ) -> None:
        """Evaluate f or h abstractly, and check that its value has the shape of `element`."""
        source = self._shape_origin(inputs[1])

        def traced(t: Any, x: Tree, u: Tree, args: Any) -> Any:
            named = {"t": t, "x": x, "u": u, "args": args}
            out = _user_code.call(name, fn, named, source)
            _user_code.check_values(name, fn, out, x)
            _user_code.check_not_integer(name, fn, out)
            return out

        out = _check_indices(name, fn, traced, *inputs)
        if not _tree.same_shape(out, element):
            raise input_error(
                f"dvax.Problem({name})",
                f"a value of shape {_tree.shapes(out)}",
                f"{name}(t, x, u, args) must be in the {space} space, whose elements have "
                f"shape {_tree.shapes(element)}; it was called with x of shape "
                f"{_tree.shapes(inputs[1])} and u of shape {_tree.shapes(inputs[2])}{source}",
                _shape_fix(name, out, element, space),
            )

    def _shape_origin(self, x: Tree) -> str:
        """Return the origin of the shape of u, for messages."""
        if self.control_space is not None:
            return f" (of control_space={self.control_space!r})"
        if _control_shape.control_zero(self.P, self.K, x) is None:
            if isinstance(self.K, AbstractSet):
                return " (that of x, since P and K fix no other and control_space= is not given)"
            return " (that of x: control_space= is not given, and a callable K fixes no shape)"
        parts = (f"{n}, {type(p).__name__}" for n, p in (("P", self.P), ("K", self.K)))
        return f" (which {' and '.join(parts)}, fix)"

    def knots(self, t0: Any, t1: Any, x: Tree, args: Any = None) -> Any:
        """Return the sorted times in (t0, t1) at which the data in f, h or K are not smooth.

        They are the knots of signals, and the times at which code compares an affine function of t
        (`t < a`).

        **Raises:** `dvax.InputError` if some data do not cover [t0, t1].
        """
        return self.data_knots(t0, x, args).within(t0, t1)

    def data_knots(self, t0: Any, x: Tree, args: Any = None) -> "Knots":
        """Return the knots of all data, and the intervals that they cover, for states shaped like x."""
        u, (evaluate, reports) = self.zero_control(x), self._listening(args)

        def traced_knots(t: Any, x: Tree, u: Tree) -> list[Any]:
            evaluate(t, x, u)
            # Knots that are computed from args leave this trace as outputs.
            all_knots = (knots for report in reports.values() for knots in report.knots)
            return [knots for knots in all_knots if not _tree.is_concrete(knots)]

        time = jnp.asarray(t0, jnp.result_type(float))
        switches = switching_times(traced_knots, time, x, u)
        for name in sorted({text for report in reports.values() for text in report.unresolved}):
            warnings.warn(
                f"{name} is evaluated at a time other than t itself (shifted, scaled, or inside "
                "another jit), so its knots in t are unknown and a step may pass one. Shift "
                "its times instead, or wrap it as dvax.signals.Function(fn, knots=...).",
                stacklevel=5,
            )
        spans = _spans(reports)
        signal_knots = (knots for report in reports.values() for knots in report.knots)
        return Knots([*filter(_tree.is_concrete, signal_knots), *switches], spans)

    def check_data(self, t0: Any, t1: Any, x: Tree, args: Any = None) -> None:
        """Evaluate K, f and h at (t0, x) with concrete values, to check the data that they create.

        **Raises:** `dvax.InputError` if such data are invalid, or do not cover [t0, t1].
        """
        if not _tree.is_concrete(t0, t1, x, args):
            return
        evaluate, reports = self._listening(args)
        evaluate(jnp.asarray(t0, jnp.result_type(float)), x, self.zero_control(x))
        _check_spans(_spans(reports), t0, t1)

    def check_spans(self, t0: Any, t1: Any, x: Tree, args: Any = None) -> None:
        """Trace K, f and h, to check that the data in them cover the time span.

        **Raises:** `dvax.InputError` if some data do not cover [t0, t1].
        """
        evaluate, reports = self._listening(args)
        time = jnp.asarray(t0, jnp.result_type(float))
        jax.eval_shape(evaluate, time, x, self.zero_control(x))
        _check_spans([span for span in _spans(reports) if _tree.is_concrete(span)], t0, t1)

    def _listening(self, args: Any) -> tuple[Callable[[Any, Tree, Tree], None], dict[str, Any]]:
        """Return a function that evaluates K, f and h, and a table of what their data report to it."""
        evaluations, reports = self._evaluations(args), {}

        def evaluate(t: Any, x: Tree, u: Tree) -> None:
            for name, function in evaluations.items():
                with listen(t) as reports[name]:
                    function(t, x, u)

        return evaluate, reports

    def _evaluations(self, args: Any) -> dict[str, Callable[[Any, Tree, Tree], Any]]:
        """Return K, f and h as functions of (t, x, u)."""
        return {
            "K": lambda t, x, u: self.set_at(t, args),
            "f": lambda t, x, u: self.f(t, x, u, args),
            "h": lambda t, x, u: self.h(t, x, u, args),
        }

    def zero_control(self, x: Tree) -> Tree:
        """Return the zero of the control space, in the floating type of x."""
        if self.control_space is None:
            zero = _control_zero(self, x)
            return _tree.zeros_like(x) if zero is None else zero
        dtype = jnp.result_type(*jax.tree_util.tree_leaves(x))
        return jax.tree_util.tree_map(lambda leaf: leaf.astype(dtype), self.control_space.zeros())


def _check_indices(name: str, fn: Any, traced: Callable[..., Any], *inputs: Any) -> Any:
    """Return the shapes of traced(*inputs), whose code contains fn, the argument `name`.

    **Raises:** `dvax.InputError` if it reads an array at a constant index outside."""
    # The arrays in args are traced, as in a run: at an array with values JAX reads at once.
    arrays, others = eqx.partition(inputs, lambda v: isinstance(v, jax.Array | np.ndarray | float))
    whole = lambda arrays: eqx.filter(traced(*eqx.combine(arrays, others)), eqx.is_array)  # noqa: E731
    program, out = jax.make_jaxpr(whole, return_shape=True)(arrays)
    if (wrong := index_outside(program)) is not None:
        raise _user_code.index_error(f"dvax.Problem({name})", fn, wrong)
    return out


def _control_zero(problem: Problem, x: Tree) -> Tree | None:
    """Return the zero of the control space that P and K determine, or None, found once for a shape."""
    leaves, tree = jax.tree_util.tree_flatten(x)
    known = _control_shapes(problem)
    key = tree, tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
    if key not in known:
        zero = _control_shape.control_zero(problem.P, problem.K, x)
        # Without values: an array may belong to a trace.
        known[key] = jax.tree_util.tree_map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), zero
        )
    return _tree.zeros_like(known[key])


@once_per_object
def _control_shapes(problem: Problem) -> dict[Any, Any]:
    """Return a table of the shapes of u, one for each shape of x."""
    return {}


@eqx.filter_jit
def _solve_compiled(
    problem: Problem, t: Any, x: Tree, args: Any, solver: Any, of_rate: bool
) -> tuple[Tree, Any, Answer]:
    """Return u_x(t) or f̃(t, x), whether the law was solved, and the answer of the solver."""

    def run(problem: Problem, t: Any, x: Tree, args: Any) -> tuple[Tree, Any, Answer]:
        vi, answer = problem._law(t, x, args, solver)
        P = problem.operator(args)

        def read(y: Tree) -> Tree:
            u = P.inverse(y)
            return problem.f(t, x, u, args) if of_rate else u

        return *unless_failed(vi, answer, read), answer

    return outlined(run, problem, t, x, args)


def _has_parts(leaf: Tree) -> bool:
    return isinstance(leaf, tuple) or jnp.ndim(leaf) > 0


def _tuple_of_numbers(x: Tree) -> InputProblem:
    numbers = ", ".join(f"{float(v):g}" if _tree.is_concrete(v) else "..." for v in x)
    return InputProblem(
        "x0", f"a tuple of {len(x)} numbers",
        "a tuple is a state in several parts, which f and h take and return as tuples",
        f"If the state is a vector, write a list or an array: x0 = [{numbers}]",
    )  # fmt: skip


def _shape_fix(name: str, out: Tree, element: Tree, space: str) -> str:
    if isinstance(out, list | tuple) and not isinstance(element, tuple):
        numbers = all(jnp.ndim(part) == 0 for part in jax.tree_util.tree_leaves(out))
        joined = "jnp.stack([...])" if numbers else "jnp.concatenate([jnp.ravel(a), ...])"
        return f"Join the components: return {joined} from {name}"
    shape = getattr(out, "shape", None)
    if space == "state":
        like_x = shape is not None and len(shape) == len(getattr(element, "shape", ()))
        return f"Return that shape from {name}" + (f", or give x0 the shape {shape}" * like_x)
    fix = f"Return that shape from {name}, or pass {space}_space= to dvax.Problem"
    given = shape is not None
    return fix + (f", such as control_space=dvax.spaces.Euclidean({shape})" if given else "")


def _spans(reports: dict[str, Any]) -> list[tuple[Any, Any, str, str]]:
    """Return (first time, last time, kind of data, function) of all data that reported."""
    return [(*span, name) for name in reports for span in reports[name].spans]


def _check_spans(spans: list[tuple[Any, Any, str, str]], t0: Any, t1: Any) -> None:
    if not _tree.is_concrete(spans, t0, t1):
        return
    places: dict[tuple[float, float, str], list[str]] = {}
    for first, last, name, where in spans:
        if float(first) > float(t0) or float(last) < float(t1):
            places.setdefault((float(first), float(last), name), []).append(where)
    short = Problems(
        InputProblem(
            f"a {name} in {', '.join(dict.fromkeys(where))}",
            f"data from t = {first:g} to {last:g}",
            f"it must cover [t0, t1] = [{float(t0):g}, {float(t1):g}]: data are never extrapolated",
            "Shorten the time span, or extend the data",
        )
        for (first, last, name), where in places.items()
    )
    short.raise_any()
