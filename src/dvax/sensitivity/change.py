"""The effect of a change of the data: actual, to first order, and certified."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._dataset import Variable, dataset, described
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..evolution import AbstractMethod, solve
from ..problem import Problem
from ..theory import ParameterBounds
from ..theory.status import Status
from .directional import Directional, check_direction, directional_derivative


class Views(NamedTuple):
    """Norms over time of the actual difference, of its first-order prediction, and certified bounds.

    `certified_sharp` is the bound with the one-sided constant, or None if this is unknown.
    """

    actual: np.ndarray
    predicted: np.ndarray
    certified: np.ndarray
    certified_sharp: np.ndarray | None


class Change(NamedTuple):
    """‖Δx‖ and ‖Δu‖ at the times `ts` for a change (Δζ, Δη) of the data.

    `x`, `u`: a `Views` each; `derivative`: the `dvax.Directional` of the prediction; `status`: that of
    the certified bounds. `table()` returns the largest values as text.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, load: load - 0.5 * x - u,
    ...     h=lambda t, x, u, load: 1.0 - 2.0 * x - u,
    ... )
    >>> bounds = dvax.parameter_bounds(problem, 2.9, 3.1, t1=2.0)
    >>> change = dvax.sensitivity.change(problem, -1.0, 0.0, 2.0, 3.0, bounds, dargs=0.1)
    >>> change.status, bool((change.x.actual <= change.x.certified).all())
    ('proved', True)

    ```
    """

    ts: np.ndarray
    x: Views
    u: Views
    derivative: Directional
    status: Status

    def to_xarray(self) -> Any:
        """Return the norms over time as an `xarray.Dataset`: `x_actual`, `x_predicted`, `x_certified`,
        `x_certified_sharp`, and the same for u.

        **Raises:** `ModuleNotFoundError` if xarray (the extra `dvax[app]`) is not installed.
        """
        variables: dict[str, Variable] = {}
        for letter, views in (("x", self.x), ("u", self.u)):
            for name, values in views._asdict().items():
                if values is not None:
                    about = described(f"‖Δ{letter}‖, {name.replace('_', ' ')}")
                    variables[f"{letter}_{name}"] = ("time",), values, about
        time = ("time",), self.ts, described("time")
        return dataset("Change.to_xarray", variables, {"time": time}, {"status": self.status})

    def table(self) -> str:
        """Return the largest values over time, as lines of text."""
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
    """Return the effect of a change (Δζ, Δη) of initial state and parameters on x and u.

    - *actual*: the difference of the solutions of both problems;
    - *predicted*: the directional derivative, valid at kinks as well;
    - *certified*: the bound of Section 6 of the paper (thm:parametrized_continuity), valid for every
      pair of parameters in the set of `bounds`, over [t0, t] for each time t.

    **Arguments:** as in `dvax.directional_derivative`, where `dx0` and `dargs` are the change itself;
    `bounds`: from `dvax.parameter_bounds`; `ts`: by default 41 times between t0 and t1.

    **Raises:** `dvax.InputError` if the bounds do not cover these times, parameters or initial states;
    the errors of `dvax.directional_derivative`.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, ell: ell - 0.5 * x - u,
    ...     h=lambda t, x, u, ell: 1.0 - 2.0 * x - u,
    ... )
    >>> bounds = dvax.parameter_bounds(problem, 2.9, 3.1, t1=2.0)
    >>> effect = dvax.sensitivity.change(problem, -1.0, 0.0, 2.0, 3.0, bounds, dargs=0.1)
    >>> print(effect.table())
                        actual   predicted   certified       sharp
    max ‖Δx‖             0.064     0.06403      0.3437      0.1264
    max ‖Δu‖            0.0407     0.04059      0.3437      0.1264

    ```
    """
    t0, t1 = float(t0), float(t1)
    times = np.linspace(t0, t1, 41) if ts is None else np.asarray(ts, float)
    x0 = _tree.as_float(x0, "x0")
    settings: dict[str, Any] = dict(method=method, rtol=rtol, atol=atol, max_steps=max_steps)
    state, control = problem.spaces(x0)
    check_direction(x0, args, dx0, dargs)
    new_x0, new_args = _add(x0, dx0), _add(args, dargs)
    _check_coverage(bounds, t0, t1, (args, new_args), [state.norm(x0), state.norm(new_x0)])
    derivative = directional_derivative(
        problem, x0, t0, t1, args, dx0=dx0, dargs=dargs, ts=times, tol=tol, **settings
    )
    sol, new_sol = derivative.sol, solve(problem, new_x0, t0, t1, new_args, times, **settings)
    norm_x, norm_u = (lambda v, s=s: np.asarray(jax.vmap(s.norm)(v)) for s in (state, control))
    x0_distance = float(state.norm(_tree.sub(new_x0, x0)))
    args_distance = _distance(args, new_args)
    bounds_at = [eqx.tree_at(lambda b: b.T, bounds, jnp.asarray(t - t0)) for t in times]

    def certified(name: str) -> np.ndarray:
        return np.array([float(getattr(b, name)(x0_distance, args_distance)) for b in bounds_at])

    sharp = bounds.constants.one_sided is not None
    x = Views(
        norm_x(_tree.sub(new_sol.xs, sol.xs)), norm_x(derivative.dxs), certified("state"),
        certified("sharp_state") if sharp else None,
    )  # fmt: skip
    u = Views(
        norm_u(_tree.sub(new_sol.us, sol.us)), norm_u(derivative.dus), certified("control"),
        certified("sharp_control") if sharp else None,
    )  # fmt: skip
    return Change(times, x, u, derivative, bounds.status)


def _add(a: Any, d: Any) -> Any:
    """Return a + d, where None in d is zero."""
    if d is None:
        return a
    leaves, structure = jtu.tree_flatten(a, is_leaf=lambda v: v is None)
    steps = jtu.tree_leaves(d, is_leaf=lambda v: v is None)
    sums = [p if s is None else p + s for p, s in zip(leaves, steps, strict=True)]
    return structure.unflatten(sums)


def _distance(a: Any, b: Any) -> float:
    """Return the Euclidean distance, over all numbers."""
    pairs = zip(jtu.tree_leaves(a), jtu.tree_leaves(b), strict=True)
    total = sum(
        float(np.sum(np.square(np.asarray(p) - np.asarray(q))))
        for p, q in pairs
        if eqx.is_array_like(p) and jnp.issubdtype(jnp.result_type(p), jnp.floating)
    )
    return float(np.sqrt(total))


def _check_coverage(
    bounds: ParameterBounds, t0: float, t1: float, all_args: tuple, x0_norms: list
) -> None:
    """Raise an `InputError` if these bounds do not cover the change."""
    wrong: list[tuple[str, str]] = []
    if not float(bounds.T) >= (t1 - t0) * (1 - 1e-12):
        wrong.append((f"T = {float(bounds.T):g}", f"the run takes {t1 - t0:g}"))
    domain = bounds.domain
    if domain is not None:
        roundoff = 1e-12 * max(abs(domain.t0), abs(domain.t1), 1.0)
        if t0 < domain.t0 - roundoff or t1 > domain.t1 + roundoff:
            wrong.append(
                (f"times [{domain.t0:g}, {domain.t1:g}]", f"the run is on [{t0:g}, {t1:g}]")
            )
        if not all(domain.contains(args) for args in all_args):
            wrong.append(("a box of parameters", "one of the two parameters is outside it"))
        radius = domain.start_radius
        if radius is not None and not max(map(float, x0_norms)) <= radius:
            norms = " and ".join(f"{float(v):.6g}" for v in x0_norms)
            wrong.append((f"‖ζ‖ ≤ {radius:g}", f"the initial states have norm {norms}"))
    if wrong:
        raise InputError(
            *(
                InputProblem(
                    "dvax.sensitivity.change(bounds)", f"bounds for {what}",
                    f"{why}, which they do not cover",
                    "Compute them with dvax.parameter_bounds(problem, low, high, x0, t0, t1)",
                )
                for what, why in wrong
            )
        )  # fmt: skip
