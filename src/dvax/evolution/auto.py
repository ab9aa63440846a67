"""The choice of a method where the caller names none."""

import math
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._jax.traces import evaluates
from .._tree import Label, Tree
from ..errors import InputError
from ..generators import (
    AbstractGenerator,
    Dense,
    Diagonal,
    Product,
    Rotation,
    Scalar,
    Zero,
)
from ..problem import Problem
from ..programs.derivatives_of_operations import has_derivative, of_operations
from ..programs.structure import analyse, independent
from .flow import is_pointwise
from .method import ETD2RK, ETD4RK, ExpRosenbrock
from .results import RESULTS
from .runge_kutta import DormandPrince
from .signature import Signature, flat, flatten

FIELD, LARGE_LAW = 64, 256
"""Entries of the law and of the state beyond which a problem is taken for a field, whose kinks are
everywhere; and entries of a law beyond which its kinks are never located. A market of 102 units and one
price takes 4 times fewer steps with its kinks located; a field of 128 points up to 2 times more, unless
the tolerance is tight."""

TIGHT = 1e-7
"""Tolerance up to which the kinks of a field of at most `LARGE_LAW` entries are located too."""

_ETD2RK, _ETD4RK, _DORMANDPRINCE, _EXPROSENBROCK = (
    ETD2RK(),
    ETD4RK(),
    DormandPrince(),
    ExpRosenbrock(),
)
"""Modules that are made once, since making and flattening one takes 10 µs."""

_LOOSE = 1e-5
"""Tolerance from which steps of order 2 with three evaluations beat those of order 4 with ten, where A
is left to its exponential and the slope of f̃ times the span is below √(tol/1e-5): the steps of order 2
grow in number with that slope, and as 1/√tol."""

_EXACT = 12
"""Unknowns up to which the exponential of A + Df costs less than the steps that it saves."""

_FAST = 300.0
"""The size of A times the span beyond which A is left to its exponential: an explicit method needs a
third of this number of steps for stability alone. For a matrix of n unknowns it is n times as large:
its exponential, formed again for each step size, costs as much as some n steps."""

_SLOPES, _SLOPES_OF_MATRICES = 60.0, 150.0
"""The spectral radius of A + Df̃ times the span, for constant derivatives of f and h, beyond which
`ExpRosenbrock` is faster, which has the linear part exactly: where it is diagonal, and where it is a
small matrix."""

_TURNS_TOL = 1e-6
"""Tolerance below which the limit of `_SLOPES_OF_MATRICES` falls for imaginary parts, as the steps of a
method of order 5 do."""

_LINEARISABLE = 256
"""Unknowns up to which `ExpRosenbrock` forms the matrix of A + Df."""


class Choice(NamedTuple):
    """A method, the reason in words ("" if the caller named it), and the method to go on with where
    steps are limited by stability (None where there is none), which is worth its own program from
    `least` more steps on."""

    method: Any
    reason: str = ""
    fallback: Any = None
    least: float = math.inf

    def text(self, where: str = "") -> Label:
        """Return the name of the method, and the reason where there is one."""
        name = type(self.method).__name__
        return Label(f"{name}: {self.reason}{where}" if self.reason else name)

    def after(self, result: RESULTS) -> "list[Choice]":
        """Return what to try, in this order, after a run of the method that ended with `result`."""
        first = type(self.method).__name__
        if result == RESULTS.stiff:
            other = type(self.fallback).__name__
            return [
                Choice(self.fallback, f"stability limited the steps of {first}"),
                Choice(self.method, f"{self.reason}, and {other} failed"),
            ]
        if result != RESULTS.step_too_small or isinstance(self.method, ETD2RK):
            return []
        # The defect of ETD2RK is zero where f̃ is a line in t, however steep, and enclosed elsewhere.
        # Over a long run DormandPrince has fewer and longer steps than both.
        others = [_DORMANDPRINCE] * isinstance(self.method, ExpRosenbrock) + [_ETD2RK]
        return [Choice(other, f"rounding limited the steps of {first}") for other in others]


class Facts(NamedTuple):
    """What the code of a problem proves, whatever its numbers: `affine` says that f and h are affine in
    (t, x, u) jointly and the bounds of K in t, so that x' is affine from kink to kink; `pointwise`,
    that f̃ acts entry by entry, and `diagonal`, that A does too; `linear`, that the derivatives of f
    and h in x and u are constant; and `derivable`, that JAX has these derivatives."""

    state: int
    law: int
    affine: bool
    pointwise: bool
    diagonal: bool
    linear: bool
    derivable: bool

    @property
    def is_field(self) -> bool:
        """Whether there are so many unknowns that steps meet kinks at any time."""
        return min(self.law, self.state) > FIELD or self.law > LARGE_LAW


def choose(
    problem: Problem,
    x0: Tree,
    args: Any,
    t0: Any,
    span: Any,
    tol: float,
    fixed: bool,
    certified: bool,
) -> Choice:
    """Choose a method for a run over `span` from t0 at the tolerance `tol` (NaN if it is traced), from
    the structure and the size of the problem."""
    if fixed:
        return Choice(_ETD2RK, "the steps are given")
    if certified:
        return Choice(_ETD2RK, "a proved bound needs a defect that can be enclosed")
    # Data may be undefined at other times than those of the run.
    dtype = _tree.dtype(x0)
    t0 = np.asarray(t0, dtype) if _tree.is_concrete(t0) else jnp.asarray(t0, dtype)
    facts = _facts(problem, t0, x0, args)
    if facts.affine and not facts.is_field and (facts.state <= _EXACT or facts.diagonal):
        return Choice(_EXPROSENBROCK, "x' is affine in t and x between kinks, where it is exact")
    rates = _rates(problem, t0, x0, args, facts)
    if not _tree.is_concrete(span):
        # Of a finite rate it is unknown how large it is over the span.
        span, rates = 1.0, rates._replace(law=math.inf) if math.isinf(rates.norm) else _UNKNOWN
    # The exponential of a matrix costs as much as many steps.
    matrices = _SLOPES_OF_MATRICES * (1.0 + (facts.state / 4) ** 3)
    # Explicit steps follow each turn, the more of them the tighter the tolerance.
    turns = matrices * min(1.0, (tol / _TURNS_TOL) ** 0.2) if tol > 0 else matrices
    if rates.slope * span > (_SLOPES if facts.diagonal else matrices) or rates.turn * span > turns:
        return Choice(
            _EXPROSENBROCK,
            f"the constant slope of Ax + f̃ times the span is {rates.slope * span:.2g}",
        )
    fast, forms_matrices = rates.norm * span, _has_matrix(problem.generator(args))
    if fast > _FAST * (facts.state if forms_matrices else 1):
        size = (
            f"the size of A times the span is {fast:.2g}"
            if fast < np.inf
            else "A discretises an operator"
        )
        reason = f"{size}, left to e^(hA)"
        if tol >= _LOOSE and rates.law * span <= math.sqrt(tol / _LOOSE):
            return _with_fallback(_ETD2RK, f"{reason}, and the tolerance is loose", facts, tol)
        return _with_fallback(_ETD4RK, reason, facts, tol)
    states = "1 state" if facts.state == 1 else f"{facts.state} states"
    why = "f̃ acts entry by entry" if facts.is_field else states
    if facts.is_field and not facts.pointwise:
        why = f"f̃ couples {facts.state} states"
        if not forms_matrices:
            # Half as many evaluations of the law a step, and e^(hA) costs little beside them.
            return _with_fallback(_ETD4RK, why, facts, tol)
    return _with_fallback(_DORMANDPRINCE, f"{why}, and nothing is known to be stiff", facts, tol)


def _with_fallback(method: Any, reason: str, facts: Facts, tol: float) -> Choice:
    if not facts.derivable or not (facts.diagonal or facts.state <= _LINEARISABLE):
        return Choice(method, reason)
    # A step of ExpRosenbrock costs some steps of another method, and many where it forms matrices.
    times = 10.0 if facts.diagonal else 10.0 + (facts.state / 16) ** 3
    # Its own steps, of order 4, become as many as the stable ones of the other method.
    times *= max(1.0, 1e-4 / tol) ** (1 / 4)
    return Choice(method, reason, _EXPROSENBROCK, 100.0 * times)


def _has_matrix(A: AbstractGenerator) -> bool:
    return any(map(_has_matrix, A.parts)) if isinstance(A, Product) else isinstance(A, Dense)


def norm(A: AbstractGenerator) -> float:
    """Return the size of A as far as it limits explicit steps, where A is a number, diagonal, a matrix
    or made of such: the spectral radius, or a bound on the norm of a large matrix. Return infinity for
    discretised operators, and zero for what is traced, of which nothing is known."""
    if isinstance(A, Product):
        return max(map(norm, A.parts))
    if isinstance(A, Zero):
        return 0.0
    if not isinstance(A, Scalar | Diagonal | Dense | Rotation):
        return math.inf
    if not _tree.is_concrete(A):
        return 0.0
    if isinstance(A, Dense):
        return _of_matrix(np.asarray(A.matrix))
    if isinstance(A, Rotation):
        return float(np.max(np.hypot(A.a, A.b)))
    return float(np.max(np.abs(A.a if isinstance(A, Scalar) else A.entries)))


def _of_matrix(matrix: np.ndarray) -> float:
    # The norm of a system in positions and velocities exceeds its frequencies by far.
    if len(matrix) <= _LINEARISABLE and np.all(np.isfinite(matrix)):
        return float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))
    return float(np.linalg.norm(matrix))


_FACTS: dict[Any, Facts] = {}
"""The facts of the latest problems, by their code and the shapes of their arrays."""

_MAX_FACTS = 256
"""Problems whose facts are kept: a key keeps the functions of a problem alive."""


def _facts(problem: Problem, t0: Any, x0: Tree, args: Any) -> Facts:
    leaves, tree = jtu.tree_flatten((x0, args))
    try:
        key = flat(problem).key, tree, tuple(map(_kind, leaves))
        if key in _FACTS:
            return _FACTS[key]
    except (InputError, TypeError):
        # What cannot be hashed is refused later.
        return _read(problem, jnp.asarray(t0), x0, _tree.as_arrays(args))
    if len(_FACTS) >= _MAX_FACTS:
        _FACTS.clear()
    return _FACTS.setdefault(key, _read(problem, jnp.asarray(t0), x0, _tree.as_arrays(args)))


def _kind(leaf: Any) -> Any:
    """Return what the facts depend on: numbers are traced, as in `signature.flatten`."""
    if eqx.is_array(leaf):
        return leaf.shape, leaf.dtype
    return float if isinstance(leaf, float) else leaf


def _read(problem: Problem, t: jax.Array, x0: Tree, args: Any) -> Facts:
    problem.check(t, x0, args)
    like = problem.zero_control(x0)
    state, law = (sum(leaf.size for leaf in jtu.tree_leaves(v)) for v in (x0, like))
    derivable = all(
        has_derivative(_plain(lambda x, u, fn=fn: fn(t, x, u, args), x0, like), x0, like)
        for fn in (problem.f, problem.h)
    )
    affine = derivable and _is_affine(problem, args, t, x0, like)
    pointwise = is_pointwise(problem, problem.operator(args), t, x0, args)
    diagonal = pointwise and isinstance(problem.generator(args), Zero | Scalar | Diagonal)
    few = state + law <= 2 * _EXACT or (diagonal and state <= FIELD)
    linear = derivable and few and _is_linear(problem, args, t, x0, like)
    return Facts(state, law, affine, pointwise, diagonal, linear, derivable)


def _is_linear(problem: Problem, args: Any, t: jax.Array, x0: Tree, like: Tree) -> bool:
    """Return whether the derivatives of f and h in x and u are constant, and A is read as a matrix."""
    if math.isinf(norm(problem.generator(args))):
        return False

    def derivative(fn: Any, t: Any, x: Tree, u: Tree) -> Tree:
        along = jtu.tree_map(jnp.ones_like, (x, u))
        return jax.jvp(_plain(lambda x, u: fn(t, x, u, args), x, u), (x, u), along)[1]

    # One direction stands for all: the code is the same.
    return all(
        independent(lambda t, x, u, fn=fn: derivative(fn, t, x, u), t, x0, like)
        for fn in (problem.f, problem.h)
    )


class Rates(NamedTuple):
    """How fast trajectories change: the size of A (`norm`), the spectral radius `slope` of Ax + f̃, the
    largest imaginary part `turn` of its eigenvalues, both zero where unknown, and the largest slope
    `law` of a pointwise f̃ at x = 0, infinite where unknown."""

    norm: float
    slope: float
    turn: float
    law: float


_UNKNOWN = Rates(0.0, 0.0, 0.0, math.inf)

_RATES: dict[Any, tuple[Any, Rates]] = {}
"""The rates of the latest problems, by the identity of the problem and of the arrays in its args, both
of which an entry keeps alive."""


def _rates(problem: Problem, t0: Any, x0: Tree, args: Any, facts: Facts) -> Rates:
    leaves = jtu.tree_leaves(args)
    key = id(problem), *(leaf if isinstance(leaf, float) else id(leaf) for leaf in leaves)
    if key in _RATES:
        return _RATES[key][1]
    # Only here, where the rates are not known: to make an array is slow beside a short run.
    t0, kept, args = jnp.asarray(t0), args, _tree.as_arrays(args)
    is_known = flat(problem).is_concrete and _tree.is_concrete(args)
    values: list[complex] | None = []
    if is_known and facts.linear:
        values = _eigenvalues(problem, t0, x0, args, "diagonal" if facts.diagonal else "matrix")
        is_known = values is not None
    law: list[complex] | None = [math.inf]
    size = norm(problem.generator(args))
    if is_known and facts.pointwise and not facts.diagonal and size > 0:
        law = _eigenvalues(problem, t0, x0, args, "without A")
        is_known = law is not None
    slope = max(map(abs, values or [0.0]))
    turn = max(abs(v.imag) for v in values or [0.0])
    rates = Rates(size, slope, turn, max(map(abs, law or [math.inf])))
    if is_known:
        if len(_RATES) >= _MAX_FACTS:
            _RATES.clear()
        _RATES[key] = (problem, kept), rates
    return rates


def _eigenvalues(
    problem: Problem, t0: jax.Array, x0: Tree, args: Any, kind: str
) -> list[complex] | None:
    """Return the eigenvalues of A + Df̃ at x = 0, for u ∈ h − 0 inside K, and for u held at the
    boundary; None where the code of f or h closes over traced values. The `kind` says whether A + Df̃
    is a "matrix", or "diagonal", or Df̃ alone, which is diagonal ("without A")."""
    with evaluates():
        found = _spectra(problem, t0, x0, args, kind)
    return None if found is None else np.concatenate(found).astype(complex).tolist()


def _spectra(problem: Problem, t: jax.Array, x0: Tree, args: Any, kind: str) -> list[Any] | None:
    # Any state will do, and x0 may be traced.
    x0 = jtu.tree_map(lambda leaf: jnp.asarray(np.zeros(leaf.shape), leaf.dtype), x0)
    like = problem.zero_control(x0)

    numbers, signature = flatten((problem,), (t, x0, like, args), kind)
    found = _derivatives(numbers, signature)
    if not _tree.is_concrete(found):
        return None
    fx, fu, hx, hu = map(np.asarray, found)
    if kind != "matrix":
        with np.errstate(divide="ignore", invalid="ignore"):
            free = fx + fu * hx / (1.0 - hu)
        return [v[np.isfinite(v)] for v in (fx, free)]
    systems = [fx]
    system = np.eye(len(hu)) - hu
    if np.linalg.matrix_rank(system) == len(hu):
        systems.append(fx + fu @ np.linalg.solve(system, hx))
    return [np.linalg.eigvals(J) for J in systems if np.all(np.isfinite(J))] or [np.zeros(1)]


@partial(jax.jit, static_argnums=1)
def _derivatives(numbers: list[Any], signature: Signature) -> list[jax.Array]:
    """Return ∂(Ax + f)/∂x, ∂f/∂u, ∂h/∂x and ∂h/∂u, or their diagonals; see `_eigenvalues`."""
    (problem,), (t, x, u, args) = signature.unflatten(numbers)
    A = problem.generator(args)
    f = lambda x, u: problem.f(t, x, u, args)  # noqa: E731
    h = lambda x, u: problem.h(t, x, u, args)  # noqa: E731
    kind = signature.options
    fx = lambda x: f(x, u) if kind == "without A" else _tree.add(A.apply(x), f(x, u))  # noqa: E731
    fns = (fx, x), (lambda u: f(x, u), u), (lambda x: h(x, u), x), (lambda u: h(x, u), u)
    # What their values do decides on stability, and not a derivative rule of a part of them.
    fns = [(_plain(fn, at), at) for fn, at in fns]
    if kind != "matrix":
        ones = lambda v: jtu.tree_map(jnp.ones_like, v)  # noqa: E731
        return [jax.jvp(fn, (at,), (ones(at),))[1].ravel() for fn, at in fns]
    return [_matrix(fn, at) for fn, at in fns]


def _plain(fn: Any, *at: Any) -> Any:
    """Return fn without the derivative rules of its parts, except in loops and branches."""
    try:
        return of_operations(fn, *at)
    except NotImplementedError:
        return fn


def _is_affine(problem: Problem, args: Any, t: jax.Array, x0: Tree, like: Tree) -> bool:
    for function in (problem.f, problem.h):
        if not analyse(lambda v, fn=function: fn(v[0], v[1], v[2], args), (t, x0, like)).affine:
            return False
    bounds = problem.set_at(t, args).intervals(like)
    return (
        bounds is not None and analyse(lambda t: problem.set_at(t, args).intervals(like), t).affine
    )


def _matrix(fn: Any, at: Tree) -> jax.Array:
    flat, back = jax.flatten_util.ravel_pytree(at)
    return jax.jacfwd(lambda v: jax.flatten_util.ravel_pytree(fn(back(v)))[0])(flat)
