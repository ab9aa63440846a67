"""One-sided directional derivatives of the solution map, at kinks as well.

Along a direction (δζ, δη) the trajectory (x, u) changes to first order by (δx, δu) with

    δx' = Aδx + (∂A)x + f_x δx + f_u δu + f_η δη,            δx(0) = δζ,
    δy(t) ∈ C(t):  ⟨F_y δy + F_x δx + F_η δη, v − δy⟩ ≥ 0 for all v ∈ C(t),

δu = P⁻¹(δy − (∂P)u), with the critical cone C(t) of K at the base trajectory (`critical`). The
variation of a coupled system is thus a coupled system, which `dvax.solve` solves. Where a
constraint is weakly active (with a zero multiplier) the cone is a half-line, and the derivative is
not linear in the direction. Otherwise it equals that of `jax.jvp`."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._dataset import dataset, described, named, over
from .._tree import Tree
from ..errors import InputError, input_error
from ..evolution import AbstractMethod, Solution, solve
from ..problem import Problem
from ..signals import Table, listen
from .critical import activity, critical_cone
from .degenerate import Kink, kinks, require_switches
from .newton import OneSided


class Directional(NamedTuple):
    """(δx, δu) at the times `ts`, the base trajectory `sol` (with dense output), and its kinks.

    `dxs`, `dus` have a leading time axis. If no kink `stays`, the derivative is linear in the
    direction.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> change = dvax.directional_derivative(problem, -1.0, 0.0, 2.0, dx0=1.0)
    >>> print(f"{float(change.dxs[0]):.6f}", [kink.kind for kink in change.kinks])
    0.061466 ['crosses', 'crosses']

    ```
    """

    ts: jax.Array
    dxs: Tree
    dus: Tree
    sol: Solution
    kinks: list[Kink]

    def to_xarray(self) -> Any:
        """Return δx and δu over time as an `xarray.Dataset`: `dx`, `du`, and `dx0`, … for parts.

        **Raises:** `ModuleNotFoundError` if xarray (the extra `dvax[app]`) is not installed.
        """
        place = "Directional.to_xarray"
        variables = {
            name: over(("time",), name, values, described(f"directional derivative {name}"))
            for symbol, rows in (("dx", self.dxs), ("du", self.dus))
            for name, (values, _) in named(rows, None, symbol, place).items()
        }
        return dataset(place, variables, {"time": (("time",), self.ts, described("time"))})


class _Base(eqx.Module):
    """The base trajectory, and the direction of the variation.

    `varied` are the leaves of args that change along `direction`, `fixed` the others. `activities` is
    the activity between kinks, as a function of time.
    """

    problem: Problem
    sol: Solution
    varied: Any
    fixed: Any
    direction: Any
    tol: Any
    activities: Any

    def args(self, varied: Any) -> Any:
        """Return args with these varied leaves."""
        return eqx.combine(varied, self.fixed)

    def at(self, t: Any) -> tuple[Tree, Tree, Tree]:
        """Return (x, u, y) of the base trajectory."""
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
    """Return (δx, δu) with x(ζ + εδζ, η + εδη) = x + ε δx + o(ε) for ε ↓ 0, and u likewise.

    **Arguments:** as in `dvax.solve`; `dx0`, `dargs`: the direction,
    shaped like x0 and args, with None for zero (also for leaves of `dargs`); `tol`: a constraint is
    active if y is within `tol` of its bound, and weakly active if F is below `tol`. It must be well
    above the error of the base trajectory. Kinks within `tol` of each other are not distinguished, and
    for sets with curved boundaries the error of the result is of the order of `tol`.

    f and h are differentiated as in `jax.jvp`, with its convention at their own kinks.

    **Returns:** a `dvax.Directional`. **Raises:** `dvax.InputError` if the direction does not fit, or K
    is a `dvax.sets.Intersection`, which does not show which constraints are active; `dvax.SolveError`
    if one of the two solves fails.

    Source: the affine variational inequality on the critical cone (Robinson 1980); Pang and Stewart
    (2009) for the differential equation.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> problem = dvax.Problem(              # stationary at the kink of u = max(x, 0)
    ...     A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 9.0),
    ...     f=lambda t, x, u, args: u - 2.0 * x, h=lambda t, x, u, args: x,
    ... )
    >>> up = dvax.directional_derivative(problem, 0.0, 0.0, 1.0, dx0=1.0)
    >>> down = dvax.directional_derivative(problem, 0.0, 0.0, 1.0, dx0=-1.0)
    >>> [round(float(d.dxs[0]), 6) for d in (up, down)]     # e⁻¹ and −e⁻²
    [0.367879, -0.135335]
    >>> [kink.kind for kink in up.kinks]
    ['stays']

    ```
    """
    if not _tree.is_concrete(x0, t0, t1, args, dx0, dargs):
        raise input_error(
            "dvax.directional_derivative", "a traced value",
            "the kinks are located between the two solves, which requires concrete values",
            "Call it outside jax.jit; away from kinks jax.jvp of dvax.solve is equal and compiles",
        )  # fmt: skip
    x0 = _tree.as_float(x0, "x0")
    dx0, varied, fixed, direction = check_direction(x0, args, dx0, dargs)
    dx0 = jtu.tree_map(lambda d, a: d.astype(a.dtype), dx0, x0)
    settings: dict[str, Any] = dict(rtol=rtol, atol=atol, max_steps=max_steps, method=method)
    sol = solve(problem, x0, t0, t1, args, ts, dense=True, **settings)
    require_switches("dvax.directional_derivative(problem)", sol.setup)
    base_kinks = kinks(sol, tol=tol)
    begin, end = float(t0), float(t1)
    inner = [t for kink in base_kinks for t in (kink.start, kink.end) if begin < t < end]
    inner += [float(t) for t in problem.knots(begin, end, x0, args)]
    times = np.array(sorted({begin, *inner, end}))
    base = _Base(problem, sol, varied, fixed, direction, jnp.asarray(tol), None)
    base = eqx.tree_at(
        lambda b: b.activities, base, _activities(base, times, tol), is_leaf=lambda v: v is None
    )
    variation_problem = Problem(
        A=_generator, P=_operator, K=_cone, f=_rate, h=_law,
        state_space=problem.state_space, control_space=problem.control_space,
    )  # fmt: skip
    # Normalise the direction: the derivative is positively homogeneous.
    scale = float(_tree_size((dx0, direction)))
    if scale == 0.0:
        dxs, dus = _tree.zeros_like(sol.xs), _tree.zeros_like(sol.us)
        return Directional(sol.ts, dxs, dus, sol, base_kinks)

    def normalise(tree: Tree) -> Tree:
        return jtu.tree_map(lambda v: v / scale, tree)

    base = eqx.tree_at(
        lambda b: b.direction, base, normalise(direction), is_leaf=lambda v: v is None
    )
    bounds = problem.set_at(sol.setup.number("t0"), args).intervals(problem.zero_control(x0))
    solver = OneSided() if bounds is None else None
    variation = solve(
        variation_problem, normalise(dx0), t0, t1, base, ts, vi_solver=solver, **settings
    )
    dus = jax.vmap(lambda t, v: _tree.add(v, _inverse_variation(base, t)))(
        variation.ts, variation.us
    )
    dxs, dus = _tree.scale(scale, variation.xs), _tree.scale(scale, dus)
    return Directional(variation.ts, dxs, dus, sol, base_kinks)


def _activities(base: _Base, times: np.ndarray, tol: float) -> Any:
    """Return the activity as piecewise constant signals; the kinks are their knots, where steps end."""

    def at(t: Any) -> Tree:
        _, _, y = base.at(t)
        return activity(_set(base, t)(base.varied), y, _multiplier(base, t), _control(base), tol)

    midpoints = jax.jit(jax.vmap(at))(jnp.asarray(0.5 * (times[:-1] + times[1:])))

    def table(leaf: Any) -> Table:
        values = np.asarray(leaf)
        return Table(times, np.concatenate([values, values[-1:]]), kind="constant")

    return jtu.tree_map(table, midpoints)


def _generator(base: _Base) -> Any:
    return base.problem.generator(base.sol.setup.args)


def _operator(base: _Base) -> Any:
    return base.problem.operator(base.sol.setup.args)


def _cone(t: Any, base: _Base) -> Any:
    flags = jtu.tree_map(
        lambda table: table(t), base.activities, is_leaf=lambda v: isinstance(v, Table)
    )
    with listen(None):  # the knots of the data are among the knots of the activities
        _, _, y = base.at(t)
        w = _multiplier(base, t)
        return critical_cone(_set(base, t), base.varied, base.direction, y, w, flags, base.tol)


def _set(base: _Base, t: Any) -> Any:
    """Return the function η ↦ K(t, η)."""
    return lambda varied: base.problem.set_at(t, base.args(varied))


def _control(base: _Base) -> Any:
    return base.problem.spaces(base.sol.setup.x0)[1]


def _multiplier(base: _Base, t: Any) -> Tree:
    """Return w = −F(y) ∈ N_K(y)."""
    x, _, y = base.at(t)
    return jtu.tree_map(jnp.negative, base.problem.frozen(t, x, base.sol.setup.args)(y))


def _inverse_variation(base: _Base, t: Any) -> Tree:
    """Return ∂(P⁻¹)y along δη, the variation of u for fixed y."""
    _, _, y = base.at(t)

    def inverse(varied: Any) -> Tree:
        return base.problem.operator(base.args(varied)).inverse(y)

    return jax.jvp(inverse, (base.varied,), (base.direction,))[1]


def _rate(t: Any, dx: Tree, v: Tree, base: _Base) -> Tree:
    """Return f_x δx + f_u δu + f_η δη + (∂A)x."""

    def f(x: Tree, u: Tree, varied: Any) -> Tree:
        return base.problem.f(t, x, u, base.args(varied))

    def generator(x: Tree, varied: Any) -> Tree:
        return base.problem.generator(base.args(varied)).apply(x)

    with listen(None):
        x, u, _ = base.at(t)
        du = _tree.add(v, _inverse_variation(base, t))
        rate = jax.jvp(f, (x, u, base.varied), (dx, du, base.direction))[1]
        drift = jax.jvp(partial(generator, x), (base.varied,), (base.direction,))[1]
    return _tree.add(rate, drift)


def _law(t: Any, dx: Tree, v: Tree, base: _Base) -> Tree:
    """Return v − (F_y δy + F_x δx + F_η δη) with δy = Pv.

    With this h the frozen operator of the variation is F_y δy + F_x δx + F_η δη."""

    def F(y: Tree, x: Tree, varied: Any) -> Tree:
        return base.problem.frozen(t, x, base.args(varied))(y)

    with listen(None):
        x, _, y = base.at(t)
        dy = base.problem.operator(base.sol.setup.args).apply(v)
        return _tree.sub(v, jax.jvp(F, (y, x, base.varied), (dy, dx, base.direction))[1])


def check_direction(x0: Tree, args: Any, dx0: Tree, dargs: Any) -> tuple[Tree, Any, Any, Any]:
    """Return (dx0, varied leaves of args, fixed leaves, direction of the varied leaves).

    Raise an `InputError` if the direction does not fit."""
    dx0 = _tree.zeros_like(x0) if dx0 is None else _tree.as_float(dx0, "dx0")
    varied, fixed, direction = _partition(args, dargs)
    _check_shapes(x0, dx0, varied, direction)
    return dx0, varied, fixed, direction


def _partition(args: Any, dargs: Any) -> tuple[Any, Any, Any]:
    """Return (varied leaves, fixed leaves, direction), as trees like args with None elsewhere."""
    leaves, structure = jtu.tree_flatten(args, is_leaf=lambda v: v is None)
    given, shape = jtu.tree_flatten(dargs, is_leaf=lambda v: v is None)
    if dargs is None:
        given, shape = [None] * len(leaves), structure
    if shape != structure:
        raise _error("dargs", f"the structure {shape}", f"it must have that of args, {structure}")
    for a, d in zip(leaves, given, strict=True):
        if d is not None and not (isinstance(a, float) or eqx.is_inexact_array(a)):
            rule = f"{a!r} in args is not of a floating type, so its direction must be None"
            raise _error("dargs", f"{_tree.short(d)}", rule)
        if d is not None and (isinstance(d, bool) or not np.all(np.isfinite(np.asarray(d)))):
            raise _error("dargs", f"{_tree.short(d)}", "its entries must be finite numbers")
    varied, fixed = (
        [a if (d is None) is is_fixed else None for a, d in zip(leaves, given, strict=True)]
        for is_fixed in (False, True)
    )
    # A tangent must have the type of its primal.
    direction = [
        None if d is None else jnp.asarray(d, jnp.result_type(a))
        for a, d in zip(leaves, given, strict=True)
    ]
    return tuple(structure.unflatten(part) for part in (varied, fixed, direction))


def _check_shapes(x0: Tree, dx0: Tree, varied: Any, direction: Any) -> None:
    for name, a, b in (("dx0", x0, dx0), ("dargs", varied, direction)):
        if not _tree.same_shape(a, b):
            raise _error(name, f"shape {_tree.shapes(b)}", f"it must have shape {_tree.shapes(a)}")


def _error(name: str, given: str, rule: str) -> InputError:
    return input_error(
        f"dvax.directional_derivative({name})", given, rule,
        "Give a direction of the same structure and shapes, with None for fixed leaves",
    )  # fmt: skip


def _tree_size(tree: Any) -> jax.Array:
    return jnp.sqrt(sum(jnp.sum(jnp.square(leaf)) for leaf in jtu.tree_leaves(tree)))
