"""A change of the data seen three ways: certified, to first order, and as it is."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..evolution import ETD4RK, AbstractMethod, solve
from ..problem import Problem
from ..theory import ParameterBounds
from ..theory.status import Status
from .directional import Directional, check_direction, directional_derivative


class Views(NamedTuple):
    """Norms over time: of the `actual` difference, of its first-order `predicted` one, and the
    `certified` bound on it, with the one-sided constant where that is known (`certified_sharp`,
    else None)."""

    actual: np.ndarray
    predicted: np.ndarray
    certified: np.ndarray
    certified_sharp: np.ndarray | None


class Change(NamedTuple):
    """‖Δx‖ and ‖Δu‖ at the times `ts` for a change (Δζ, Δη) of the data.

    `x`, `u`: `Views` each; `derivative`: the `dvax.Directional` behind the prediction; `status`: of the
    certified bounds. `table()` prints the largest of each.
    """

    ts: np.ndarray
    x: Views
    u: Views
    derivative: Directional
    status: Status

    def table(self) -> str:
        """The largest values over time, as lines of text."""
        head = f"{'':<14}{'actual':>12}{'predicted':>12}{'certified':>12}{'sharp':>12}"
        rows = [head]
        for name, views in (("max ‖Δx‖", self.x), ("max ‖Δu‖", self.u)):
            numbers = (None if v is None else float(np.max(v)) for v in views)
            cells = ("-" if v is None else f"{v:.4g}" for v in numbers)
            rows.append(f"{name:<14}" + "".join(f"{cell:>12}" for cell in cells))
        return "\n".join(rows)


def change(
    problem: Problem,
    x0: Tree,
    t0: float,
    t1: float,
    args: Any,
    bounds: ParameterBounds,
    *,
    dx0: Tree = None,
    dargs: Any = None,
    ts: Any = None,
    method: AbstractMethod | None = None,
    rtol: float = 1e-8,
    atol: float = 1e-10,
    tol: float = 1e-6,
    max_steps: int = 2**14,
) -> Change:
    """What a change (Δζ, Δη) of initial state and parameters does to x and u.

    - *actual*: both problems are solved;
    - *predicted*: the directional derivative, at kinks as well;
    - *certified*: Section 6 of the paper (thm:parametrized_continuity), for every pair of parameters in
      the set that `bounds` are for, over [t0, t] for each time t.

    **Arguments:** as in `dvax.directional_derivative`, with `dx0` and `dargs` the whole change, not a
    direction; `bounds`: from `dvax.parameter_bounds`; `ts`: 41 times between t0 and t1 by default.

    **Raises:** `dvax.InputError` where the bounds are not for these times, parameters or initial
    states; what `dvax.directional_derivative` raises.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, ell: ell - 0.5 * x - u,
    ...     h=lambda t, x, u, ell: 1.0 - 2.0 * x - u,
    ... )
    >>> bounds = dvax.parameter_bounds(problem, 2.9, 3.1, t1=2.0)
    >>> seen = dvax.sensitivity.change(problem, -1.0, 0.0, 2.0, 3.0, bounds, dargs=0.1)
    >>> print(seen.table())
                        actual   predicted   certified       sharp
    max ‖Δx‖             0.064     0.06403      0.3437      0.1264
    max ‖Δu‖            0.0407     0.04059      0.3437      0.1264

    ```
    """
    t0, t1 = float(t0), float(t1)
    times = np.linspace(t0, t1, 41) if ts is None else np.asarray(ts, float)
    method = ETD4RK() if method is None else method
    x0 = _tree.as_float(x0, "x0")
    tight: dict[str, Any] = dict(method=method, rtol=rtol, atol=atol, max_steps=max_steps)
    state, control = problem.spaces(x0)
    check_direction(x0, args, dx0, dargs)
    moved_x0, moved_args = _moved(x0, dx0), _moved(args, dargs)
    _covers(bounds, t0, t1, (args, moved_args), [state.norm(x0), state.norm(moved_x0)])
    found = directional_derivative(
        problem, x0, t0, t1, args, dx0=dx0, dargs=dargs, ts=times, tol=tol, **tight
    )
    other = solve(problem, moved_x0, t0, t1, moved_args, times, **tight)
    norm_x, norm_u = (lambda v, s=s: np.asarray(jax.vmap(s.norm)(v)) for s in (state, control))
    gap = float(state.norm(_tree.sub(moved_x0, x0)))
    distance = _distance(args, moved_args)
    each = [eqx.tree_at(lambda b: b.T, bounds, jnp.asarray(t - t0)) for t in times]
    of = lambda name: np.array([float(getattr(b, name)(gap, distance)) for b in each])  # noqa: E731
    sharp = bounds.constants.one_sided is not None
    x = Views(
        norm_x(_tree.sub(other.xs, found.sol.xs)), norm_x(found.dxs), of("state"),
        of("sharp_state") if sharp else None,
    )  # fmt: skip
    u = Views(
        norm_u(_tree.sub(other.us, found.sol.us)), norm_u(found.dus), of("control"),
        of("sharp_control") if sharp else None,
    )  # fmt: skip
    return Change(times, x, u, found, bounds.status)


def _moved(a: Any, d: Any) -> Any:
    """a + d, where None stands still."""
    if d is None:
        return a
    leaves, structure = jtu.tree_flatten(a, is_leaf=lambda v: v is None)
    steps = jtu.tree_leaves(d, is_leaf=lambda v: v is None)
    moved = [p if s is None else p + s for p, s in zip(leaves, steps, strict=True)]
    return structure.unflatten(moved)


def _distance(a: Any, b: Any) -> float:
    """Euclidean, over all numbers."""
    pairs = zip(jtu.tree_leaves(a), jtu.tree_leaves(b), strict=True)
    total = sum(
        float(np.sum(np.square(np.asarray(p) - np.asarray(q))))
        for p, q in pairs
        if eqx.is_array_like(p) and jnp.issubdtype(jnp.result_type(p), jnp.floating)
    )
    return float(np.sqrt(total))


def _covers(bounds: ParameterBounds, t0: float, t1: float, each: tuple, starts: list) -> None:
    """Raise an `InputError` where these bounds say nothing about such a change."""
    wrong: list[tuple[str, str]] = []
    if not float(bounds.T) >= (t1 - t0) * (1 - 1e-12):
        wrong.append((f"T = {float(bounds.T):g}", f"the run takes {t1 - t0:g}"))
    made = bounds.domain
    if made is not None:
        room = 1e-12 * max(abs(made.t0), abs(made.t1), 1.0)
        if t0 < made.t0 - room or t1 > made.t1 + room:
            wrong.append((f"times [{made.t0:g}, {made.t1:g}]", f"the run is on [{t0:g}, {t1:g}]"))
        if not all(made.contains(args) for args in each):
            wrong.append(("a box of parameters", "one of the two parameters is outside it"))
        if made.start_radius is not None and not max(map(float, starts)) <= made.start_radius:
            norms = " and ".join(f"{float(v):.6g}" for v in starts)
            wrong.append((f"‖ζ‖ ≤ {made.start_radius:g}", f"the initial states have norm {norms}"))
    if wrong:
        raise InputError(
            *(
                InputProblem(
                    "dvax.sensitivity.change(bounds)", f"bounds made for {what}",
                    f"{why}, of which they say nothing",
                    "Make them for this: dvax.parameter_bounds(problem, low, high, x0, t0, t1)",
                )
                for what, why in wrong
            )
        )  # fmt: skip
