"""Cournot competition with a sticky price."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ... import _tree
from ...errors import InputError, InputProblem, Problems, input_error
from ...evolution import ExpRosenbrock, Solution, solve
from ...formats.rts_gmlc import RTS, read_rts
from ...generators import Scalar
from ...operators import Scaling
from ...problem import Problem
from ...sets import Box
from ...signals import AbstractSignal, Table, as_signal
from ...spaces import Euclidean
from ...theory import Constants
from .deviation import largest_gain
from .merit import MeritOrder

_BISECTIONS = 60
"""Enough bisections to reduce a price range to the spacing of floating-point numbers."""


class Market(eqx.Module):
    """A market with a sticky price and firms that account for their effect on it.

        p' = s(α(t) − b 1ᵀu − p)
        u ∈ K(t) = Π [0, capᵢ(t)],   0 ∈ M u + c − p1 + N_{K(t)}(u),   M = diag(a) + b G

    The state p is the price, and uᵢ the output of unit i. α(t) − bQ is the inverse demand, to which
    the price relaxes at the rate s. Unit i has the marginal cost cᵢ + aᵢuᵢ; Gᵢⱼ = 1 if i and j
    belong to the same firm. The law is the optimality condition of the firms, which anticipate that
    a unit of output changes the price by −b: p − b Q_f = cᵢ + aᵢuᵢ for each unit that is not at a
    bound. In equilibrium p = α − bQ, and u is the Cournot–Nash equilibrium of the hour
    (`equilibrium`).

    The problem has A = −s, f = s(α(t) − b1ᵀu), P = I and h = u − Mu − c + p1. M is symmetric, so
    F(y) = My + c − p1 is strongly monotone with γ = λ_min(M) ≥ min a.

    **Units:** u, cap in MW; p, α, c in $/MWh; a, b in $/MWh per MW; t in hours, s in 1/h.

    **Arguments:** `cost`: c; `slope`: a > 0; `firm`: the number of each unit's firm, 0, 1, …; `b` > 0;
    `speed`: s > 0; `intercept`: α; `capacity`: cap ≥ 0. The last two are a number and an array,
    `dvax.signals` or callables of t.

    **Raises:** `dvax.InputError` with all invalid arguments.

    Source: Fershtman and Kamien 1987, Econometrica 55, 1151–1164 (sticky prices).

    ```python
    >>> from dvax.models.market import Market
    >>> market = Market(
    ...     cost=[10.0, 30.0, 20.0], slope=[0.1, 0.1, 0.1], firm=[0, 0, 1], b=0.1, speed=2.0,
    ...     intercept=100.0, capacity=[100.0, 500.0, 500.0],
    ... )
    >>> price, u = market.equilibrium(0.0)
    >>> [round(float(v), 6) for v in (price, *u)]       # unit 0 at its capacity
    [60.0, 100.0, 100.0, 200.0]

    ```
    """

    cost: jax.Array
    slope: jax.Array
    firms: jax.Array
    b: jax.Array
    speed: jax.Array
    intercept: AbstractSignal
    capacity: AbstractSignal

    def __init__(
        self,
        *,
        cost: Any,
        slope: Any,
        firm: Any,
        b: Any,
        speed: Any,
        intercept: Any,
        capacity: Any,
    ):
        wrong = Problems()
        given = {"cost": (cost, 1), "slope": (slope, 1), "b": (b, 0), "speed": (speed, 0)}
        for name, (value, axes) in given.items():
            try:
                array = _tree.as_float(value, f"dvax.models.Market({name})")
            except InputError as error:
                wrong += error.problems
                continue
            setattr(self, name, array)
            wrong += _array_problems(name, array, axes)
        for name, value in (("intercept", intercept), ("capacity", capacity)):
            with wrong.collect():
                setattr(self, name, _signal(value, f"dvax.models.Market({name})"))
        wrong += _firm_problems(firm)
        if not wrong:
            wrong += self._size_problems(firm)
        wrong.raise_any()
        self.firms = jnp.asarray(np.eye(int(np.max(firm)) + 1)[np.asarray(firm)])

    @classmethod
    def from_rts(
        cls,
        data: str | Path | RTS,
        start_hour: Any = 0,
        hours: Any = 168,
        *,
        speed: float = 6.0,
        reference_price: float = 40.0,
        elasticity: float = 0.3,
    ) -> "Market":
        """Return the market of `hours` hours of the RTS-GMLC data from `start_hour` on.

        It has 102 units, and each area is a firm. t is in hours from the first row of the data.
        Load and capacities are interpolated linearly. The demand is linear, with constant slope,
        and equals the load of the hour at the reference price: b = reference_price/(elasticity ·
        mean load), α(t) = reference_price + b · load(t).

        **Arguments:** `data`: the folder, or the result of `dvax.formats.read_rts`.

        **Raises:** `dvax.InputError` with the errors in the files, and if the hours are not in the
        data."""
        rts = data if isinstance(data, RTS) else read_rts(data)
        wrong = Problems(_hour_problems(start_hour, hours, len(rts.load)))
        for name, value in (("reference_price", reference_price), ("elasticity", elasticity)):
            wrong += _array_problems(name, _tree.as_float(value, f"dvax.models.Market({name})"), 0)
        wrong.raise_any()
        b = reference_price / (elasticity * float(rts.load.mean()))
        rows = slice(start_hour, start_hour + hours)
        times = np.arange(start_hour, start_hour + hours, dtype=float)
        _, firm = np.unique(rts.area, return_inverse=True)
        return cls(
            cost=rts.cost,
            slope=rts.slope,
            firm=firm,
            b=b,
            speed=speed,
            intercept=Table(times, reference_price + b * rts.load[rows]),
            capacity=Table(times, rts.capacity[rows]),
        )

    @property
    def fit(self) -> str:
        """How the model relates to the class of the theory."""
        return "exact"

    @property
    def problem(self) -> Problem:
        """The coupled problem, with a scalar state and a control of n entries."""
        return Problem(
            A=Scalar(-_tree.host(self.speed)),
            P=Scaling(1.0),
            K=self._set,
            f=self._rate,
            h=self._feedback,
            state_space=Euclidean(()),
            control_space=Euclidean(self.cost.shape),
        )

    @property
    def law_solver(self) -> MeritOrder:
        """The solver of the law of this market in closed form, for `vi_solver=` of `dvax.solve`."""
        return MeritOrder(self.slope, self.b, self.firms)

    @property
    def constants(self) -> Constants:
        """The proved constants.

        γ = min a; L_F and β_h follow from the eigenvalues of M; α_h = √n, β_f = s b √n, ω = −s. The
        one-sided rate is μ = −s: the response of a monotone law increases with the price, so
        −b1ᵀ(u₁ − u₂)(p₁ − p₂) ≤ 0. The rate of the paper, s(b n/γ − 1), ignores this sign."""
        cost, slope, firms, b, s = _tree.host(
            (self.cost, self.slope, self.firms, self.b, self.speed)
        )
        lib = _tree.array_module(slope, firms, b)
        n = cost.shape[0]
        ends = lib.linalg.eigvalsh(lib.diag(slope) + b * (firms @ firms.T))
        return Constants(
            gamma=lib.min(slope),
            L_F=ends[-1],
            alpha_h=n**0.5,
            beta_h=lib.max(lib.abs(1.0 - ends)),
            alpha_f=0.0,
            beta_f=s * b * n**0.5,
            M=1.0,
            omega=-s,
            m_P=1.0,
            norm_P_inv=1.0,
            one_sided=-s,
            status="proved",
        )

    def gain(self, t: Any, price: Any) -> jax.Array:
        """Return the gain b dQ/dp of the response; prices relax at the rate s(1 + gain).

        With S_f = Σ 1/aᵢ over the units of f that are not at a bound, the gain is Σ_f bS_f/(1 +
        bS_f), which is less than the number of firms. The certified L̃ = s b n/γ is larger: it uses
        the smallest a for all units and ignores the firms."""
        market = self.problem

        def total_output(p: jax.Array) -> jax.Array:
            return jnp.sum(market.response(t, p, solver=self.law_solver))

        return self.b * jax.jvp(total_output, (price,), (jnp.ones_like(price),))[1]

    def equilibrium(self, t: Any) -> tuple[jax.Array, jax.Array]:
        """Return the Cournot–Nash equilibrium (p, u) with the data of the time t.

        p is the zero of p − α + b 1ᵀu_p, which is piecewise linear with a slope of at least 1.
        Bisection locates the linear piece. A final Newton step is exact there, and carries the
        derivative."""
        t = jnp.asarray(t, self.cost.dtype)
        alpha, capacity = self.intercept(t), self.capacity(t)
        return _equilibrium(self, t, alpha, alpha - self.b * jnp.sum(capacity))

    def run(self, t0: float | None = None, t1: float | None = None, **settings: Any) -> Solution:
        """Solve from t0 to t1 (by default those of the data), and save every hour.

        The initial price is the equilibrium at t0. The gain of the law makes the problem stiff, which
        `ExpRosenbrock` treats exactly. `settings` are passed to `dvax.solve`.

        **Raises:** `dvax.InputError` if neither the arguments nor the data determine t0 and t1.
        """
        first, last = self.intercept.span()
        begin, end = first if t0 is None else t0, last if t1 is None else t1
        if not (np.isfinite(begin) and np.isfinite(end)):
            raise input_error(
                "dvax.models.Market.run(t0, t1)",
                f"from {begin} to {end}",
                "the intercept is no table, so the times of the run must be given",
                "Give t0 and t1",
            )
        price = self.equilibrium(begin)[0]
        ts = np.append(np.arange(float(begin), float(end)), float(end))
        options: dict[str, Any] = dict(
            ts=ts, rtol=1e-8, atol=1e-8, method=ExpRosenbrock(), vi_solver=self.law_solver
        )
        return solve(self.problem, price, float(begin), float(end), **(options | settings))

    def figures(self, solution: Solution) -> dict[str, Any]:
        """Return the results at the saved times.

        `price`: the Cournot–Nash price (`equilibrium`), in $/MWh; `sticky_price`: that of the solution,
        in $/MWh; `max_deviation_profit`: the largest profit, in $/h, that any firm could gain by a
        unilateral deviation within its capacities, in equilibrium and along the solution. It is
        computed independently of the law (`dvax.models.market.largest_gain`), and 0 up to roundoff."""
        prices, outputs = _equilibria(self, solution.ts)
        cost, slope, firms = map(np.asarray, (self.cost, self.slope, self.firms))
        capacity = np.asarray(jax.vmap(self.capacity.value)(solution.ts))
        gains = [
            largest_gain(np.asarray(p), np.asarray(u), capacity, cost, slope, firms, float(self.b))
            for p, u in ((prices, outputs), (solution.xs, solution.us))
        ]
        return {
            "price": [float(p) for p in prices],
            "sticky_price": [float(p) for p in solution.xs],
            "max_deviation_profit": max(gains),
        }

    def _set(self, t: Any, args: Any) -> Box:
        return Box(0.0, self.capacity(t))

    def _rate(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return self.speed * (self.intercept(t) - self.b * jnp.sum(u))

    def _feedback(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        Mu = self.slope * u + self.b * (self.firms @ (self.firms.T @ u))
        return u - Mu - self.cost + x

    def _size_problems(self, firm: Any) -> list[InputProblem]:
        n = len(np.asarray(firm))
        # Evaluate the capacities at a time at which they are defined.
        first = self.capacity.span()[0]
        at = float(first) if np.isfinite(first) else 0.0
        values = self.capacity.value(at)
        wrong = Problems(
            InputProblem(
                f"dvax.models.Market({name})", f"shape {shape}",
                f"it must have an entry for each of the {n} units in `firm`", "Add the missing entries",
            )
            for name, shape in (
                ("cost", self.cost.shape), ("slope", self.slope.shape),
                ("capacity", jnp.shape(values)),
            )
            if shape != (n,)
        )  # fmt: skip
        samples = self.capacity.values if isinstance(self.capacity, Table) else values
        if _tree.is_concrete(samples) and bool(np.any(np.asarray(samples) < 0)):
            k = np.unravel_index(np.argmin(np.asarray(samples)), np.shape(samples))
            wrong.add(
                "dvax.models.Market(capacity)", f"{float(np.min(samples)):g} for unit {k[-1]}",
                "capacities must be ≥ 0, or the set is empty", "Correct the capacity",
            )  # fmt: skip
        return wrong


@eqx.filter_jit
def _equilibria(market: Market, times: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(market.equilibrium)(times)


@eqx.filter_jit
def _equilibrium(market: Market, t: Any, alpha: jax.Array, lowest: jax.Array) -> tuple:
    def response(p: jax.Array) -> jax.Array:
        return market.problem.law(t, p, solver=market.law_solver).y

    def excess(p: jax.Array) -> jax.Array:
        return p - alpha + market.b * jnp.sum(response(p))

    def bisect(_: Any, bracket: tuple) -> tuple:
        middle = 0.5 * (bracket[0] + bracket[1])
        above_root = excess(middle) > 0
        low = jnp.where(above_root, bracket[0], middle)
        return low, jnp.where(above_root, middle, bracket[1])

    bracket = jax.lax.stop_gradient((lowest, alpha))
    low, high = jax.lax.stop_gradient(jax.lax.fori_loop(0, _BISECTIONS, bisect, bracket))
    middle = 0.5 * (low + high)
    value, slope = jax.jvp(excess, (middle,), (jnp.ones_like(middle),))
    p = middle - value / jax.lax.stop_gradient(slope)
    return p, response(p)


def _array_problems(name: str, value: jax.Array, axes: int) -> list[InputProblem]:
    what = "a number" if axes == 0 else "a vector with one entry a unit"
    positive = name != "cost"
    holds = jnp.ndim(value) == axes
    if holds and _tree.is_concrete(value):
        array = np.asarray(value)
        holds = bool(np.all(np.isfinite(array)) and not (positive and np.any(array <= 0)))
    if holds:
        return []
    return [
        InputProblem(
            f"dvax.models.Market({name})",
            _tree.short(value),
            f"it must be {what}, finite{' and positive' if positive else ''}",
            "Without a slope the response is not unique: give a small one"
            if name == "slope"
            else "Correct the value",
        )
    ]


def _firm_problems(firm: Any) -> list[InputProblem]:
    numbers = np.asarray(firm)
    holds = numbers.ndim == 1 and numbers.size > 0 and numbers.dtype.kind in "iu"
    if holds and np.array_equal(np.unique(numbers), np.arange(numbers.max() + 1)):
        return []
    return [
        InputProblem(
            "dvax.models.Market(firm)",
            _tree.short(numbers),
            "it must be a vector of integers, the number of each unit's firm: 0, 1, … without gaps",
            "Number the firms with np.unique(names, return_inverse=True)[1]",
        )
    ]


def _hour_problems(start: Any, hours: Any, rows: int) -> list[InputProblem]:
    integers = all(isinstance(v, int) and not isinstance(v, bool) for v in (start, hours))
    if integers and start >= 0 and hours >= 2 and start + hours <= rows:
        return []
    return [
        InputProblem(
            "dvax.models.Market.from_rts(start_hour, hours)",
            f"{start!r} and {hours!r}",
            f"the data have the hours 0 to {rows - 1}, and a run needs at least two of them",
            "Give integers in this range",
        )
    ]


def _signal(value: Any, name: str) -> AbstractSignal:
    return as_signal(value, lambda v: _tree.as_float(v, name))
