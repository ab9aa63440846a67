"""Cournot firms under a price that is slow to move."""

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

_HALVINGS = 60
"""From a price range to the spacing of doubles in it."""


class Market(eqx.Module):
    """A market whose price is sticky, and firms that know that they move it.

        p' = s(α(t) − b 1ᵀu − p)
        u ∈ K(t) = Π [0, capᵢ(t)],   0 ∈ M u + c − p1 + N_{K(t)}(u),   M = diag(a) + b G

    p is the price and the state; uᵢ what unit i makes. α(t) − bQ is the inverse demand, towards which
    the price moves at the rate s. Unit i has the marginal cost cᵢ + aᵢuᵢ; Gᵢⱼ = 1 where i and j belong
    to the same firm. The law says that no firm gains by making another amount, which would move the
    price along the demand by −b a unit: p − b Q_f = cᵢ + aᵢuᵢ at each of its units that is not at a
    bound. At rest p = α − bQ, and u is the Cournot–Nash equilibrium of the hour (`equilibrium`).

    As a problem of this library: A = −s, f = s(α(t) − b1ᵀu), P = I, h = u − Mu − c + p1. M is
    symmetric, so that F(y) = My + c − p1 is strongly monotone with γ = λ_min(M) ≥ min a.

    **Units:** u, cap in MW; p, α, c in $/MWh; a, b in $/MWh per MW; t in hours, s in 1/h.

    **Arguments:** `cost`: c; `slope`: a > 0; `firm`: the number of each unit's firm, 0, 1, …; `b` > 0;
    `speed`: s > 0; `intercept`: α; `capacity`: cap ≥ 0. The last two are numbers (an array, for the
    capacities), `dvax.signals` or callables of t.

    **Raises:** `dvax.InputError` for everything that breaks its rule.

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
            wrong += _breaks_rule(name, array, axes)
        for name, value in (("intercept", intercept), ("capacity", capacity)):
            with wrong.collect():
                setattr(self, name, _signal(value, f"dvax.models.Market({name})"))
        wrong += _not_firms(firm)
        if not wrong:
            wrong += self._sizes(firm)
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
        """The market of `hours` hours of the RTS-GMLC data from `start_hour` on: 102 units, a firm an
        area. t counts hours from the first row of the data; between rows, load and capacities are
        joined by lines.

        Demand is a line through the load of the hour at the reference price, of the same slope always:
        b = reference_price/(elasticity · mean load), α(t) = reference_price + b · load(t).

        **Arguments:** `data`: the folder (`dvax.formats.read_rts`), or what was read from it.

        **Raises:** `dvax.InputError` for what is wrong in the files, and for hours that they have not.
        """
        rts = data if isinstance(data, RTS) else read_rts(data)
        wrong = Problems(_not_hours(start_hour, hours, len(rts.load)))
        for name, value in (("reference_price", reference_price), ("elasticity", elasticity)):
            wrong += _breaks_rule(name, _tree.as_float(value, f"dvax.models.Market({name})"), 0)
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
        """The model is in the class of the theory as it stands."""
        return "exact"

    @property
    def problem(self) -> Problem:
        """The coupled system, with a scalar state and a control of n entries."""
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
        """What solves the law of this market in closed form: `vi_solver=` of `dvax.solve`."""
        return MeritOrder(self.slope, self.b, self.firms)

    @property
    def constants(self) -> Constants:
        """γ = min a and L_F, β_h from the eigenvalues of M; α_h = √n, β_f = s b √n, ω = −s; and the
        one-sided rate μ = −s: the response of a monotone law rises with the price, so that
        −b1ᵀ(u₁ − u₂)(p₁ − p₂) ≤ 0. The paper's s(b n/γ − 1) ignores that sign."""
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
        """b dQ/dp of the response, a number below that of firms: prices relax at the rate s(1 + gain).

        With S_f = Σ 1/aᵢ over the units of f that are at no bound it is Σ_f bS_f/(1 + bS_f), where the
        certified L̃ = s b n/γ has the worst a and no firm.
        """
        market = self.problem
        made = lambda p: jnp.sum(market.response(t, p, solver=self.law_solver))  # noqa: E731
        return self.b * jax.jvp(made, (price,), (jnp.ones_like(price),))[1]

    def equilibrium(self, t: Any) -> tuple[jax.Array, jax.Array]:
        """(p, u) at rest with the data of the time t: p = α − b 1ᵀu_p, the Cournot–Nash point. p is
        the zero of p − α + b 1ᵀu_p, which rises with a slope of at least 1 and is linear in pieces:
        found by halving and one step of Newton's method, exact there, which carries the derivative."""
        t = jnp.asarray(t, self.cost.dtype)
        alpha, capacity = self.intercept(t), self.capacity(t)
        return _rest(self, t, alpha, alpha - self.b * jnp.sum(capacity))

    def run(self, t0: float | None = None, t1: float | None = None, **settings: Any) -> Solution:
        """The price from t0 to t1 (those of the data by default), saved at every hour, from the
        equilibrium at t0 on. `ExpRosenbrock` takes the gain of the law, which is stiff for others;
        `settings` are those of `dvax.solve`.

        **Raises:** `dvax.InputError` where neither t0, t1 nor the data say when.
        """
        first, last = self.intercept.span()
        begin, end = first if t0 is None else t0, last if t1 is None else t1
        if not (np.isfinite(begin) and np.isfinite(end)):
            raise input_error(
                "dvax.models.Market.run(t0, t1)",
                f"from {begin} to {end}",
                "the intercept is no table, which would say how long the run is",
                "Give t0 and t1",
            )
        price = self.equilibrium(begin)[0]
        ts = np.append(np.arange(float(begin), float(end)), float(end))
        options: dict[str, Any] = dict(
            ts=ts, rtol=1e-8, atol=1e-8, method=ExpRosenbrock(), vi_solver=self.law_solver
        )
        return solve(self.problem, price, float(begin), float(end), **(options | settings))

    def figures(self, solution: Solution) -> dict[str, Any]:
        """At every saved time, in $/MWh: `price`, the Cournot–Nash one (`equilibrium`), and
        `sticky_price`, that of the solution, which follows it. `max_deviation_profit`: the most that
        any firm could gain at any of these times, at rest or under way, in $/h, by making something
        else within its capacities, while the others make what they make and the price moves along the
        demand; found by a search that shares nothing with the law (`dvax.models.market.largest_gain`).
        It is 0 up to rounding."""
        rest, at_rest = _rests(self, solution.ts)
        cost, slope, firms = map(np.asarray, (self.cost, self.slope, self.firms))
        capacity = np.asarray(jax.vmap(self.capacity.value)(solution.ts))
        gains = [
            largest_gain(np.asarray(p), np.asarray(u), capacity, cost, slope, firms, float(self.b))
            for p, u in ((rest, at_rest), (solution.xs, solution.us))
        ]
        return {
            "price": [float(p) for p in rest],
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

    def _sizes(self, firm: Any) -> list[InputProblem]:
        n = len(np.asarray(firm))
        # A callable may be asked at any time that it is defined at.
        first = self.capacity.span()[0]
        at = float(first) if np.isfinite(first) else 0.0
        values = self.capacity.value(at)
        wrong = Problems(
            InputProblem(
                f"dvax.models.Market({name})", f"shape {shape}",
                f"it has an entry for each of the {n} units that `firm` names", "Complete it",
            )
            for name, shape in (
                ("cost", self.cost.shape), ("slope", self.slope.shape),
                ("capacity", jnp.shape(values)),
            )
            if shape != (n,)
        )  # fmt: skip
        known = self.capacity.values if isinstance(self.capacity, Table) else values
        if _tree.is_concrete(known) and bool(np.any(np.asarray(known) < 0)):
            k = np.unravel_index(np.argmin(np.asarray(known)), np.shape(known))
            wrong.add(
                "dvax.models.Market(capacity)", f"{float(np.min(known)):g} for unit {k[-1]}",
                "a capacity is ≥ 0, or the set of what can be made is empty", "Fix it",
            )  # fmt: skip
        return wrong


@eqx.filter_jit
def _rests(market: Market, times: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(market.equilibrium)(times)


@eqx.filter_jit
def _rest(market: Market, t: Any, alpha: jax.Array, bottom: jax.Array) -> tuple:
    def response(p: jax.Array) -> jax.Array:
        return market.problem.law(t, p, solver=market.law_solver).y

    def excess(p: jax.Array) -> jax.Array:
        return p - alpha + market.b * jnp.sum(response(p))

    def halve(_: Any, ends: tuple) -> tuple:
        middle = 0.5 * (ends[0] + ends[1])
        above = excess(middle) > 0
        return jnp.where(above, ends[0], middle), jnp.where(above, middle, ends[1])

    ends = jax.lax.stop_gradient((bottom, alpha))
    low, high = jax.lax.stop_gradient(jax.lax.fori_loop(0, _HALVINGS, halve, ends))
    near = 0.5 * (low + high)
    value, slope = jax.jvp(excess, (near,), (jnp.ones_like(near),))
    p = near - value / jax.lax.stop_gradient(slope)
    return p, response(p)


def _breaks_rule(name: str, value: jax.Array, axes: int) -> list[InputProblem]:
    what = "a number" if axes == 0 else "a vector with an entry a unit"
    positive = name != "cost"
    holds = jnp.ndim(value) == axes
    if holds and _tree.is_concrete(value):
        known = np.asarray(value)
        holds = bool(np.all(np.isfinite(known)) and not (positive and np.any(known <= 0)))
    if holds:
        return []
    return [
        InputProblem(
            f"dvax.models.Market({name})",
            _tree.short(value),
            f"it must be {what}, finite{' and positive' if positive else ''}",
            "Costs without a slope have no single answer: give a small one"
            if name == "slope"
            else "Fix the value",
        )
    ]


def _not_firms(firm: Any) -> list[InputProblem]:
    numbers = np.asarray(firm)
    holds = numbers.ndim == 1 and numbers.size > 0 and numbers.dtype.kind in "iu"
    if holds and np.array_equal(np.unique(numbers), np.arange(numbers.max() + 1)):
        return []
    return [
        InputProblem(
            "dvax.models.Market(firm)",
            _tree.short(numbers),
            "it must be a vector of integers, the number of each unit's firm: 0, 1, … without a gap",
            "Number the firms with np.unique(names, return_inverse=True)[1]",
        )
    ]


def _not_hours(start: Any, hours: Any, rows: int) -> list[InputProblem]:
    integers = all(isinstance(v, int) and not isinstance(v, bool) for v in (start, hours))
    if integers and start >= 0 and hours >= 2 and start + hours <= rows:
        return []
    return [
        InputProblem(
            "dvax.models.Market.from_rts(start_hour, hours)",
            f"{start!r} and {hours!r}",
            f"the data have the hours 0 to {rows - 1}, and a run at least two of them",
            "Name whole hours inside",
        )
    ]


def _signal(value: Any, name: str) -> AbstractSignal:
    return as_signal(value, lambda v: _tree.as_float(v, name))
