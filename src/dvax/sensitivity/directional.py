"""The one-sided directional derivative of the solution map, at kinks as well.

Along a direction (δζ, δη) the trajectory (x, u) changes, to first order, by (δx, δu) with

    δx' = Aδx + (∂A)x + f_x δx + f_u δu + f_η δη,            δx(0) = δζ,
    δy(t) ∈ C(t):  ⟨F_y δy + F_x δx + F_η δη, v − δy⟩ ≥ 0 for all v ∈ C(t),

δu = P⁻¹(δy − (∂P)u), with the critical cone C(t) of K at the base trajectory (`critical`): the
variation of a coupled system is a coupled system, and `dvax.solve` solves it. Where y is held weakly
(at a bound that exerts no force) the cone is a half-line and the derivative is not linear in the
direction; everywhere else this is what `jax.jvp` gives.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..evolution import ETD4RK, AbstractMethod, Solution, solve
from ..problem import Problem
from ..signals import Table, listen
from .critical import code, critical
from .degenerate import Kink, kinks
from .newton import OneSided


class Directional(NamedTuple):
    """(δx, δu) at the times `ts`, for the base trajectory `sol` (with its steps), and the kinks of it.

    `dxs`, `dus` have a leading time axis. Where no kink `stays`, the derivative is the ordinary one.
    """

    ts: jax.Array
    dxs: Tree
    dus: Tree
    sol: Solution
    kinks: list[Kink]


class _Base(eqx.Module):
    """What the variation is about."""

    problem: Problem
    sol: Solution
    moving: Any
    rest: Any
    direction: Any
    tol: Any
    codes: Any

    def args(self, moving: Any) -> Any:
        return eqx.combine(moving, self.rest)

    def at(self, t: Any) -> tuple[Tree, Tree, Tree]:
        """(x, u, y) of the base trajectory."""
        x, u = self.sol.evaluate(t)
        return x, u, self.problem.operator(self.sol.setup.args).apply(u)


def directional_derivative(
    problem: Problem,
    x0: Tree,
    t0: Any,
    t1: Any,
    args: Any = None,
    *,
    dx0: Tree = None,
    dargs: Any = None,
    ts: Any = None,
    method: AbstractMethod | None = None,
    rtol: float = 1e-8,
    atol: float = 1e-10,
    tol: float = 1e-6,
    max_steps: int = 2**14,
) -> Directional:
    """(δx, δu) with x(ζ + εδζ, η + εδη) = x + ε δx + o(ε) for ε ↓ 0, and u likewise.

    **Arguments:** as in `dvax.solve` (the method is ETD4RK by default); `dx0`, `dargs`: the
    direction, shaped like x0 and args, zero where None (`None` leaves in `dargs` stand still as
    well); `tol`: a bound counts as reached within it, in y, and as exerting no force below it, in F.
    It must be well above the error of the base trajectory; what happens within it of a kink is taken
    to happen at the kink, and on sets with curved boundaries the answer is off by its order.

    f and h are differentiated as `jax.jvp` does: kinks of their own have its convention.

    **Returns:** a `dvax.Directional`. **Raises:** `dvax.InputError` where the direction does not fit;
    `dvax.SolveError` where one of the two solves fails.

    Source: the affine variational inequality on the critical cone (Robinson 1980); Pang and Stewart
    (2009) for the differential equation.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> rest = dvax.Problem(                 # at rest on the kink of u = max(x, 0)
    ...     A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 9.0),
    ...     f=lambda t, x, u, args: u - 2.0 * x, h=lambda t, x, u, args: x,
    ... )
    >>> up = dvax.directional_derivative(rest, 0.0, 0.0, 1.0, dx0=1.0)
    >>> down = dvax.directional_derivative(rest, 0.0, 0.0, 1.0, dx0=-1.0)
    >>> [round(float(d.dxs[0]), 6) for d in (up, down)]     # e⁻¹ and −e⁻²
    [0.367879, -0.135335]
    >>> [kink.kind for kink in up.kinks]
    ['stays']

    ```
    """
    if not _tree.is_concrete(x0, t0, t1, args, dx0, dargs):
        raise InputError(
            InputProblem(
                "dvax.directional_derivative", "a traced value",
                "where kinks are is looked up between the two solves, which no compiled program can",
                "Call it outside jax.jit; off kinks jax.jvp of dvax.solve is the same and compiles",
            )
        )  # fmt: skip
    x0 = _tree.as_float(x0, "x0")
    dx0, moving, rest, direction = check_direction(x0, args, dx0, dargs)
    dx0 = jtu.tree_map(lambda d, a: d.astype(a.dtype), dx0, x0)
    method = ETD4RK() if method is None else method
    settings: dict[str, Any] = dict(rtol=rtol, atol=atol, max_steps=max_steps, method=method)
    sol = solve(problem, x0, t0, t1, args, ts, dense=True, **settings)
    found = kinks(sol, tol=tol)
    begin, end = float(t0), float(t1)
    inner = [t for kink in found for t in (kink.start, kink.end) if begin < t < end]
    inner += [float(t) for t in problem.knots(begin, end, x0, args)]
    times = np.array(sorted({begin, *inner, end}))
    base = _Base(problem, sol, moving, rest, direction, jnp.asarray(tol), None)
    base = eqx.tree_at(
        lambda b: b.codes, base, _codes(base, times, tol), is_leaf=lambda v: v is None
    )
    varied = Problem(
        A=_generator, P=_operator, K=_cone, f=_rate, h=_law,
        state_space=problem.state_space, control_space=problem.control_space,
    )  # fmt: skip
    # Of first order in the direction, whatever its size.
    scale = float(_tree_size((dx0, direction)))
    if scale == 0.0:
        return Directional(sol.ts, _tree.zeros_like(sol.xs), _tree.zeros_like(sol.us), sol, found)
    unit = lambda tree: jtu.tree_map(lambda v: v / scale, tree)  # noqa: E731
    base = eqx.tree_at(lambda b: b.direction, base, unit(direction), is_leaf=lambda v: v is None)
    pointwise = problem.set_at(sol.setup.number("t0"), args).intervals(problem.zero_control(x0))
    solver = OneSided() if pointwise is None else None
    variation = solve(varied, unit(dx0), t0, t1, base, ts, vi_solver=solver, **settings)
    dus = jax.vmap(lambda t, v: _tree.add(v, _shift(base, t)))(variation.ts, variation.us)
    back = lambda tree: jtu.tree_map(lambda v: scale * v, tree)  # noqa: E731
    return Directional(variation.ts, back(variation.xs), back(dus), sol, found)


def _codes(base: _Base, times: np.ndarray, tol: float) -> Any:
    """What is constant between kinks, as signals that say where those are: steps end there."""

    def at(t: Any) -> Tree:
        _, _, y = base.at(t)
        return code(_set(base, t)(base.moving), y, _force(base, t), _control(base), tol)

    middles = jax.jit(jax.vmap(at))(jnp.asarray(0.5 * (times[:-1] + times[1:])))
    whole = lambda leaf: np.concatenate([np.asarray(leaf), np.asarray(leaf)[-1:]])  # noqa: E731
    return jtu.tree_map(lambda leaf: Table(times, whole(leaf), kind="constant"), middles)


def _generator(base: _Base) -> Any:
    return base.problem.generator(base.sol.setup.args)


def _operator(base: _Base) -> Any:
    return base.problem.operator(base.sol.setup.args)


def _cone(t: Any, base: _Base) -> Any:
    now = jtu.tree_map(lambda table: table(t), base.codes, is_leaf=lambda v: isinstance(v, Table))
    with listen(None):  # the knots of the data are among the times of the codes
        _, _, y = base.at(t)
        return critical(
            _set(base, t), base.moving, base.direction, y, _force(base, t), now, base.tol
        )


def _set(base: _Base, t: Any) -> Any:
    """η ↦ K(t, η)."""
    return lambda moving: base.problem.set_at(t, base.args(moving))


def _control(base: _Base) -> Any:
    return base.problem.spaces(base.sol.setup.x0)[1]


def _force(base: _Base, t: Any) -> Tree:
    """w = −F(y) ∈ N_K(y)."""
    x, _, y = base.at(t)
    return jtu.tree_map(jnp.negative, base.problem.frozen(t, x, base.sol.setup.args)(y))


def _shift(base: _Base, t: Any) -> Tree:
    """∂(P⁻¹)y along δη: what u moves by while y stands."""
    _, _, y = base.at(t)
    inverse = lambda moving: base.problem.operator(base.args(moving)).inverse(y)  # noqa: E731
    return jax.jvp(inverse, (base.moving,), (base.direction,))[1]


def _rate(t: Any, dx: Tree, v: Tree, base: _Base) -> Tree:
    """f_x δx + f_u δu + f_η δη + (∂A)x."""
    f = lambda x, u, moving: base.problem.f(t, x, u, base.args(moving))  # noqa: E731
    push = lambda x, moving: base.problem.generator(base.args(moving)).apply(x)  # noqa: E731
    with listen(None):
        x, u, _ = base.at(t)
        du = _tree.add(v, _shift(base, t))
        rate = jax.jvp(f, (x, u, base.moving), (dx, du, base.direction))[1]
        drift = jax.jvp(partial(push, x), (base.moving,), (base.direction,))[1]
    return _tree.add(rate, drift)


def _law(t: Any, dx: Tree, v: Tree, base: _Base) -> Tree:
    """v − (F_y δy + F_x δx + F_η δη) with δy = Pv: the h of which that is the frozen operator."""
    F = lambda y, x, moving: base.problem.frozen(t, x, base.args(moving))(y)  # noqa: E731
    with listen(None):
        x, _, y = base.at(t)
        dy = base.problem.operator(base.sol.setup.args).apply(v)
        return _tree.sub(v, jax.jvp(F, (y, x, base.moving), (dy, dx, base.direction))[1])


def check_direction(x0: Tree, args: Any, dx0: Tree, dargs: Any) -> tuple[Tree, Any, Any, Any]:
    """(dx0, what moves of args, the rest, its direction); an `InputError` where they do not fit."""
    dx0 = _tree.zeros_like(x0) if dx0 is None else _tree.as_float(dx0, "dx0")
    moving, rest, direction = _apart(args, dargs)
    _check(x0, dx0, moving, direction)
    return dx0, moving, rest, direction


def _apart(args: Any, dargs: Any) -> tuple[Any, Any, Any]:
    """(what moves, the rest, the direction), each shaped like args with None in the other places."""
    leaves, structure = jtu.tree_flatten(args, is_leaf=lambda v: v is None)
    given, shape = jtu.tree_flatten(dargs, is_leaf=lambda v: v is None)
    if dargs is None:
        given, shape = [None] * len(leaves), structure
    if shape != structure:
        raise _wrong("dargs", f"the structure {shape}", f"that of args is {structure}")
    for a, d in zip(leaves, given, strict=True):
        if d is not None and not (isinstance(a, float) or eqx.is_inexact_array(a)):
            rule = f"{a!r} in args is no real number with a point"
            raise _wrong("dargs", f"{_tree.short(d)}", rule)
        if d is not None and (isinstance(d, bool) or not np.all(np.isfinite(np.asarray(d)))):
            raise _wrong("dargs", f"{_tree.short(d)}", "it must be made of finite numbers")
    moving, rest = (
        [a if (d is None) is still else None for a, d in zip(leaves, given, strict=True)]
        for still in (False, True)
    )
    # Tangents have the type of what they are tangents of.
    along = [
        None if d is None else jnp.asarray(d, jnp.result_type(a))
        for a, d in zip(leaves, given, strict=True)
    ]
    return tuple(structure.unflatten(part) for part in (moving, rest, along))


def _check(x0: Tree, dx0: Tree, moving: Any, direction: Any) -> None:
    for name, a, b in (("dx0", x0, dx0), ("dargs", moving, direction)):
        if not _tree.same_shape(a, b):
            raise _wrong(name, f"shape {_tree.shapes(b)}", f"it must have shape {_tree.shapes(a)}")


def _wrong(name: str, got: str, rule: str) -> InputError:
    return InputError(
        InputProblem(
            f"dvax.directional_derivative({name})", got,
            f"{rule}: a direction has a number for every number that moves",
            "Give it that shape, or leave it out where nothing moves",
        )
    )  # fmt: skip


def _tree_size(tree: Any) -> jax.Array:
    return jnp.sqrt(sum(jnp.sum(jnp.square(leaf)) for leaf in jtu.tree_leaves(tree)))
