"""An American put as an obstacle problem with a penalty law, and bounds on the errors of its value.

Prices are multiples of the strike, s = ln S, and t is the time to expiry in years. Let ψ = (1 − S)₊ be
what exercise pays, and L the Black–Scholes operator

    L V = ½σ²V_ss + (r − d − ½σ²)V_s − rV.

The value solves V_t − L V = u, u ≥ 0, V ≥ ψ, u(V − ψ) = 0 (the obstacle problem). Let g be the solution
of L g = 0 that is ψ at the low end of the grid and 0 at the high end, and V = g + e^{as}x with
a = ½ − (r − d)/σ². Then x vanishes at both ends, and x' = A x + u with A = ½σ²∂² − c, which
`dvax.generators.Elliptic` diagonalises. The penalty law of width ε is

    u = max(0, q + (b − x)/ε),   b = e^{−as}(ψ − g),   q = 0 or q = max(0, −A b).

docs/published/american-options.md proves that the two choices of q enclose the value of the obstacle
problem on the grid, and that the difference of the two is at most ε max q.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dvax

_NODES = 6
"""Nodes of the interpolation polynomial between the grid and a price."""
_HIGH_END = 5.0
"""The high end of the grid, in units of σ√T above the strike."""
_FITTED = (0.1, 0.4)
"""Distances from the exercise boundary, in units of σ√T, between which a polynomial is fitted."""
_SAVED = 200
"""Saved times, which resolve in time how much of a defect reaches a price at expiry."""


class Put(NamedTuple):
    """Interest rate and dividend yield in 1/year, volatility in 1/√year, time to expiry in years."""

    rate: Any
    dividend: Any
    volatility: Any
    expiry: Any = 1.0


class Grid(NamedTuple):
    """Cells of equal `width` in s = ln S, `below` of them below the strike, which is on a face."""

    below: int
    above: int
    width: float

    @property
    def cells(self) -> int:
        return self.below + self.above

    @property
    def s(self) -> np.ndarray:
        return self.width * (np.arange(self.cells) + 0.5 - self.below)

    @classmethod
    def of(cls, put: Put, resolution: int) -> "Grid":
        """Return the grid with `resolution` cells in σ√T; its low end is exercised at all times."""
        deviation = put.volatility * np.sqrt(put.expiry)
        below = int(np.ceil(-np.log(0.95 * perpetual_boundary(put)) * 20 / deviation))
        return cls(
            -(-below * resolution // 20), round(_HIGH_END * resolution), deviation / resolution
        )


def perpetual_boundary(put: Put) -> float:
    """Return the price below which a put without expiry is exercised (Merton 1973)."""
    drift, half = put.rate - put.dividend - 0.5 * put.volatility**2, 0.5 * put.volatility**2
    root = (-drift - np.sqrt(drift**2 + 4 * half * put.rate)) / (2 * half)
    return float(root / (root - 1))


@functools.cache
def problem(grid: Grid) -> dvax.Problem:
    """Return the penalised problem of a grid; `arguments` returns its `args`."""
    n, width = grid.cells, grid.width

    def generator(args: dict[str, Any]) -> dvax.generators.Elliptic:
        return dvax.generators.Elliptic(
            n, n * width, "dirichlet", args["diffusion"], reaction=args["reaction"],
            scheme="differences",
        )  # fmt: skip

    with jax.ensure_compile_time_eval():  # the cached problem must not keep tracers
        space = dvax.spaces.L2(jnp.full(n, width))
        return dvax.Problem(
            A=generator,
            P=dvax.operators.Scaling(1.0),
            K=dvax.sets.Box(0.0, jnp.inf),
            f=lambda t, x, u, args: u,
            h=lambda t, x, u, args: args["force"] + args["stiffness"] * (args["obstacle"] - x),
            state_space=space,
            control_space=space,
        )


def arguments(grid: Grid, put: Put, width: Any, above: bool) -> dict[str, Any]:
    """Return the `args` of the penalty law of width ε = `width` years, with the force q if `above`.

    They are differentiable in the numbers of `put`."""
    a, c, half = _transformation(put)
    s = jnp.asarray(grid.s)
    obstacle = (jnp.maximum(1.0 - jnp.exp(s), 0.0) - lift(grid, put)) / jnp.exp(a * s)
    args = {"diffusion": half, "reaction": -c, "obstacle": obstacle, "stiffness": 1.0 / width}
    pull = -problem(grid).generator(args).apply(obstacle)
    return args | {"force": jnp.maximum(pull, 0.0) if above else jnp.zeros_like(obstacle)}


def _transformation(put: Put) -> tuple[Any, Any, Any]:
    """Return a, c and ½σ², for which V = e^{as}x turns L into ½σ²∂² − c."""
    half = 0.5 * put.volatility**2
    drift = put.rate - put.dividend - half
    return -drift / (2.0 * half), put.rate + drift**2 / (4.0 * half), half


def lift(grid: Grid, put: Put) -> jax.Array:
    """Return g: L g = 0, ψ at the low end of the grid, 0 at its high end."""
    a, c, half = _transformation(put)
    low, high = -grid.width * grid.below, grid.width * grid.above
    s, decay = jnp.asarray(grid.s), jnp.sqrt(c / half)
    shape = jnp.sinh(decay * (high - s)) / jnp.sinh(decay * (high - low))
    return (1.0 - jnp.exp(low)) * jnp.exp(a * (s - low)) * shape


def values(grid: Grid, put: Put, x: Any) -> jax.Array:
    """Return V = g + e^{as}x at the nodes."""
    return lift(grid, put) + jnp.exp(_transformation(put)[0] * jnp.asarray(grid.s)) * x


def weights(grid: Grid, price: Any) -> tuple[Any, jax.Array]:
    """Return the nodes next to a price, and the weights of the polynomial through them."""
    place = jnp.log(price) / grid.width + grid.below - 0.5
    first = jax.lax.stop_gradient(jnp.floor(place)) - _NODES // 2 + 1
    nodes = first + jnp.arange(_NODES, dtype=place.dtype)
    gaps = nodes[:, None] - nodes[None, :]
    is_own = gaps == 0.0
    factors = jnp.where(is_own, 1.0, (place - nodes)[None, :] / jnp.where(is_own, 1.0, gaps))
    return nodes.astype(int), jnp.prod(factors, axis=1)


def at_price(grid: Grid, on_grid: Any, price: Any) -> jax.Array:
    """Interpolate node values at a price; differentiable in the price."""
    nodes, factors = weights(grid, price)
    return jnp.sum(factors * on_grid[nodes])


class Enclosure(NamedTuple):
    """A run with each choice of q: V at the nodes, and bounds at the prices asked for.

    `penalty` and `time` are proved: half of the distance of the two runs, and how far the computed
    runs are from the exact ones. `status` is the weakest of the assumptions and of the bounds."""

    low: jax.Array
    high: jax.Array
    prices: np.ndarray
    values: np.ndarray
    penalty: np.ndarray
    time: np.ndarray
    status: str
    steps: int


def initial(grid: Grid, put: Put) -> jax.Array:
    """Return x at expiry: V = ψ."""
    return arguments(grid, put, 1.0, False)["obstacle"]


def solve(
    grid: Grid, put: Put, width: float, above: bool, tol: float, ts: Any = None, **options: Any
) -> Any:
    """Return the `dvax.Solution` of one penalty law; `options` are those of `dvax.solve`."""
    args = arguments(grid, put, width, above)
    return dvax.solve(
        problem(grid), initial(grid, put), 0.0, put.expiry, args, ts, rtol=tol, atol=tol,
        method=dvax.ETD2RK(), **options,
    )  # fmt: skip


def enclose(grid: Grid, put: Put, width: float, tol: float, prices: Any) -> Enclosure:
    """Enclose the value of the obstacle problem on the grid at `prices` (multiples of the strike)."""
    prices = np.asarray(prices, float)
    remaining = np.concatenate([np.geomspace(put.expiry, 1e-6 * put.expiry, _SAVED), [0.0]])
    runs, errors, statuses = [], [], []
    for above in (False, True):
        sol = solve(grid, put, width, above, tol, put.expiry - remaining)
        check = dvax.verify(
            problem(grid), initial(grid, put), 0.0, put.expiry, arguments(grid, put, width, above)
        )
        assert check.constants is not None
        bound = dvax.bound_error(problem(grid), sol, check.constants)
        statuses += [check.status, bound.status]
        runs.append(sol)
        errors.append(_time_errors(grid, put, sol, prices))
    low, high = (values(grid, put, sol.xs[-1]) for sol in runs)
    places = [weights(grid, p) for p in prices]
    half = [float(jnp.abs(w) @ (0.5 * jnp.abs(high - low)[nodes])) for nodes, w in places]
    middle = [float(at_price(grid, 0.5 * (low + high), p)) for p in prices]
    weakest = next((s for s in ("refuted", "estimated", "declared") if s in statuses), "proved")
    return Enclosure(
        low, high, prices, np.array(middle), np.array(half), np.max(errors, axis=0), weakest,
        sum(int(sol.stats["steps"]) for sol in runs),
    )  # fmt: skip


def _time_errors(grid: Grid, put: Put, sol: Any, prices: np.ndarray) -> np.ndarray:
    """Bound the errors of V at prices that the time integration causes, from the enclosed defect δ.

    u decreases in x at every node, and A has no negative entries off its diagonal, so that
    |e|' ≤ A|e| + |δ| entrywise, and |e(T)| ≤ ∫ e^{(T − t)A}|δ(t)| dt. With v the moduli of the
    interpolation weights times e^{as}, ⟨v, |e(T)|⟩ ≤ ∫ ‖e^{(T − t)A}v‖ ‖δ(t)‖ dt. The norm decreases in
    T − t.
    """
    scale = np.exp(_transformation(put)[0] * grid.s)
    v = np.zeros((len(prices), grid.cells))
    for row, price in zip(v, prices):
        nodes, factors = weights(grid, price)
        row[np.asarray(nodes)] = np.abs(factors)
    v = jnp.asarray(v * scale / grid.width)
    generator = problem(grid).generator(sol.setup.args)

    def norms(t: jax.Array) -> jax.Array:
        at_t = jax.vmap(lambda row: generator.semigroup(t, row))(v)
        return jnp.sqrt(grid.width * jnp.sum(at_t**2, axis=1))

    # The defect from the start of the step that contains a saved time, up to the next saved time.
    defects = sol.defect[1:] - sol.completed_defect[0][:-1]
    return np.asarray(defects @ jax.vmap(norms)(sol.ts[-1] - sol.ts[1:]))


def boundary(grid: Grid, put: Put, on_grid: Any) -> float:
    """Estimate the price below which the put is exercised: where √(V − ψ) extrapolates to 0.

    Near it V − ψ ≈ (r/σ²)(s − s*)². The polynomial, s as a cubic in the square root, is fitted beyond
    the layer in which the penalty law switches off."""
    gap = np.asarray(on_grid) - np.maximum(1.0 - np.exp(grid.s), 0.0)
    root = np.sqrt(np.maximum(gap, 0.0) / (put.rate * put.expiry))
    near = (root >= _FITTED[0]) & (root <= _FITTED[1]) & (grid.s < 0.0)
    return float(np.exp(np.polynomial.polynomial.polyfit(root[near], grid.s[near], 3)[0]))
