"""Power markets by the hour: piecewise linear capacities and demand, at hours up to 8784, with wind
whose capacity is within a few MW of its unconstrained production."""

from typing import Any

import jax.numpy as jnp
import numpy as np

import dvax
from dvax.models.market import MeritOrder

from . import projections as by_hand
from .family import Array, Family, Sample, accuracy_for, traced
from .reference import Written

YEAR = 8784


def _hours(rng: Any, hours: int) -> tuple[float, Array]:
    start = int(rng.integers(0, YEAR - hours))
    if rng.random() < 0.3:
        start = YEAR - hours
    return float(start), np.arange(hours + 1.0)


def _walk(rng: Any, hours: int, size: float) -> Array:
    """A daily wave with noise between 0.5 and 1.5 of `size`."""
    t = np.arange(hours + 1.0)
    wave = 0.3 * np.sin(2 * np.pi * (t / 24.0 + rng.uniform())) + 0.05 * rng.normal(size=hours + 1)
    return size * (1.0 + np.clip(wave, -0.5, 0.5))


def sticky_price(units: int, hours: int, methods: tuple[str, ...], samples: int) -> Family:
    """p' = s(α(t) − b Σu − p), uᵢ = clip((p − cᵢ)/(aᵢ + b), 0, capᵢ(t)): `dvax.models.Market` with one
    unit a firm, its numbers drawn so that the renewable units come close to their capacities."""
    table = lambda args, name: dvax.signals.Table(args["hours"], args[name])  # noqa: E731
    problem = dvax.Problem(
        A=lambda args: dvax.generators.Scalar(-args["s"]),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(0.0, table(args, "cap")(t)),
        f=lambda t, x, u, args: args["s"] * (table(args, "alpha")(t) - args["b"] * jnp.sum(u)),
        h=lambda t, x, u, args: u - (args["a"] + args["b"]) * u - args["c"] + x,
        state_space=dvax.spaces.Euclidean(),
        control_space=dvax.spaces.Euclidean(units),
    )

    def draw(rng: Any) -> Sample:
        start, t = _hours(rng, hours)
        size, b, s = rng.uniform(20.0, 400.0, units), 10.0 ** rng.uniform(-2.5, -1.5), 6.0
        c, a = rng.uniform(0.0, 40.0, units), 10.0 ** rng.uniform(-2.5, -0.5, units)
        alpha = _walk(rng, hours, 45.0 + b * size.sum())
        cap = np.tile(size, (hours + 1, 1))
        wind = rng.choice(units, units // 4, replace=False)
        c[wind] = 0.0
        price = np.array([_balance(alpha[k], b, a, c, cap[k]) for k in range(hours + 1)])
        for i in wind:
            # Within a few MW of what it would make, above and below.
            free = price / (a[i] + b)
            cap[:, i] = np.maximum(
                free + rng.normal(size=hours + 1) * rng.choice([0.1, 3.0, 100.0]), 0.0
            )
        price = _balance(alpha[0], b, a, c, cap[0])

        def rate(now: float, x: Array) -> Array:
            k = min(int(now), hours - 1)
            share = now - k
            limit = cap[k] + share * (cap[k + 1] - cap[k])
            demand = alpha[k] + share * (alpha[k + 1] - alpha[k])
            u = np.clip((x[0] - c) / (a + b), 0.0, limit)
            return np.array([s * (demand - b * u.sum() - x[0])])

        rtol, atol = [(1e-6, 1e-9), (1e-4, 1e-7)][int(rng.integers(2))]
        args = {
            k: traced(v)
            for k, v in dict(hours=start + t, cap=cap, alpha=alpha, a=a, b=b, c=c, s=s).items()
        }
        ts = start + t[1:]
        written = Written(
            rate, np.array([price]), float(hours), list(t), accuracy=accuracy_for(rtol)
        )
        return Sample(args, jnp.asarray(price), start, start + hours, ts, rtol, atol, written)

    return Family(f"sticky price of {units} units over {hours} h", methods, problem, draw, samples)


def _balance(alpha: float, b: float, a: Array, c: Array, cap: Array) -> float:
    """p = α − b Σ clip((p − c)/(a + b), 0, cap), by halving."""
    low, high = -1.0, alpha + 1.0
    for _ in range(60):
        p = 0.5 * (low + high)
        rising = p - alpha + b * np.clip((p - c) / (a + b), 0.0, cap).sum() < 0
        low, high = (p, high) if rising else (low, p)
    return 0.5 * (low + high)


def firms(units: int, owners: int, hours: int, methods: tuple[str, ...], samples: int) -> Family:
    """The same with several units a firm, u the Cournot response of `dvax.models.market.MeritOrder`:
    flat costs of renewable units, whose capacity is 0 at times and else near what they would make."""
    own = np.eye(owners)[np.arange(units) % owners]
    table = lambda args, name: dvax.signals.Table(args["hours"], args[name])  # noqa: E731
    pooled = lambda args, u: args["b"] * (jnp.asarray(own) @ (jnp.asarray(own.T) @ u))  # noqa: E731
    problem = dvax.Problem(
        A=lambda args: dvax.generators.Scalar(-args["s"]),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(0.0, table(args, "cap")(t)),
        f=lambda t, x, u, args: args["s"] * (table(args, "alpha")(t) - args["b"] * jnp.sum(u)),
        h=lambda t, x, u, args: u - args["a"] * u - pooled(args, u) - args["c"] + x,
        state_space=dvax.spaces.Euclidean(),
        control_space=dvax.spaces.Euclidean(units),
    )

    def draw(rng: Any) -> Sample:
        start, t = _hours(rng, hours)
        size, b, s = rng.uniform(10.0, 400.0, units), 10.0 ** rng.uniform(-2.5, -1.5), 6.0
        c, a = rng.uniform(5.0, 40.0, units), 10.0 ** rng.uniform(-3.0, -1.0, units)
        alpha = _walk(rng, hours, 40.0 + 0.6 * b * size.sum())
        cap = np.tile(size, (hours + 1, 1))
        wind = np.sort(rng.choice(units, units // 3, replace=False))
        c[wind], a[wind] = 0.0, 1e-3

        def made(p: float, limit: Array) -> Array:
            """Firm by firm the Q with Σ clip((p − c − bQ)/a, 0, limit) = Q, between two breakpoints."""
            u = np.empty(units)
            for f in range(owners):
                i = np.flatnonzero(own[:, f])
                top = limit[i]
                points = np.concatenate([p - c[i], p - c[i] - a[i] * top]) / b
                points = np.sort(np.clip(points, 0.0, top.sum()))
                points = np.concatenate([[0.0], points, [top.sum()]])
                level = p - b * points[:, None] - c[i]
                excess = np.clip(level / a[i], 0.0, top).sum(axis=1) - points  # falling
                k = int(np.clip(np.searchsorted(-excess, 0.0), 1, len(points) - 1))
                fall = excess[k - 1] - excess[k]
                share = excess[k - 1] / fall if fall > 0 else 0.0
                Q = points[k - 1] + share * (points[k] - points[k - 1])
                u[i] = np.clip((p - c[i] - b * Q) / a[i], 0.0, top)
            return u

        def balance(k: int) -> float:
            low, high = -1.0, alpha[k] + 1.0
            for _ in range(50):
                p = 0.5 * (low + high)
                rising = p - alpha[k] + b * made(p, cap[k]).sum() < 0
                low, high = (p, high) if rising else (low, p)
            return 0.5 * (low + high)

        solar = wind[::2]
        cap[:, solar] *= np.clip(np.sin(2 * np.pi * t / 24.0 - rng.uniform(0, 6)), 0.0, None)[
            :, None
        ]
        unbound = cap.copy()
        unbound[:, wind[1::2]] = 2e3
        for k in range(hours + 1):
            # What the first wind unit would make, were it free: it comes within a few MW of it.
            low, high = -1.0, alpha[k] + 1.0
            for _ in range(30):
                p = 0.5 * (low + high)
                rising = p - alpha[k] + b * made(p, unbound[k]).sum() < 0
                low, high = (p, high) if rising else (low, p)
            free = made(p, unbound[k])
            noise = rng.normal(size=len(wind[1::2])) * rng.choice([0.1, 3.0, 300.0])
            cap[k, wind[1::2]] = np.maximum(free[wind[1::2]] + noise, 0.0)
        price = balance(0)

        def rate(now: float, x: Array) -> Array:
            k = min(int(now), hours - 1)
            share = now - k
            limit = cap[k] + share * (cap[k + 1] - cap[k])
            demand = alpha[k] + share * (alpha[k + 1] - alpha[k])
            return np.array([s * (demand - b * made(x[0], limit).sum() - x[0])])

        rtol, atol = [(1e-6, 1e-9), (1e-4, 1e-7)][int(rng.integers(2))]
        data = dict(hours=start + t, cap=cap, alpha=alpha, a=a, b=b, c=c, s=s)
        args = {k: traced(v) for k, v in data.items()}
        law = MeritOrder(jnp.asarray(a), jnp.asarray(b), jnp.asarray(own))
        written = Written(
            rate, np.array([price]), float(hours), list(t), accuracy=accuracy_for(rtol)
        )
        return Sample(
            args, jnp.asarray(price), start, start + hours, start + t[1:], rtol, atol, written, law
        )

    return Family(
        f"market of {units} units in {owners} firms over {hours} h", methods, problem, draw, samples
    )


def balanced(units: int, hours: int, methods: tuple[str, ...], samples: int) -> Family:
    """Units that follow a dispatch: x' = (u − x)/τ with u the nearest to r(t) + θx of those with
    0 ≤ u ≤ cap(t), Σu = demand(t)."""
    rows = jnp.concatenate([jnp.eye(units), -jnp.eye(units)])
    table = lambda args, name: dvax.signals.Table(args["hours"], args[name])  # noqa: E731
    problem = dvax.Problem(
        A=lambda args: dvax.generators.Scalar(-1.0 / args["tau"]),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Polyhedron(
            rows,
            jnp.concatenate([table(args, "cap")(t), jnp.zeros(units)]),
            jnp.ones((1, units)),
            table(args, "demand")(t)[None],
        ),
        f=lambda t, x, u, args: u / args["tau"],
        h=lambda t, x, u, args: args["theta"] * x + args["r"],
        state_space=dvax.spaces.Euclidean(units),
        control_space=dvax.spaces.Euclidean(units),
    )

    def draw(rng: Any) -> Sample:
        start, t = _hours(rng, hours)
        size = rng.uniform(0.5, 2.0, units)
        cap = np.stack([_walk(rng, hours, v) for v in size], axis=1)
        demand = _walk(rng, hours, 0.55 * size.sum())
        demand = np.minimum(demand, 0.95 * cap.sum(axis=1))
        tau, theta = float(rng.uniform(0.3, 3.0)), float(rng.uniform(0.0, 0.8))
        r, x0 = 0.5 * rng.normal(size=units), 0.5 * size

        def rate(now: float, x: Array) -> Array:
            k = min(int(now), hours - 1)
            share = now - k
            limit = cap[k] + share * (cap[k + 1] - cap[k])
            total = demand[k] + share * (demand[k + 1] - demand[k])
            u = by_hand.box_and_total(theta * x + r, np.zeros(units), limit, total)
            return (u - x) / tau

        rtol, atol = [(1e-6, 1e-9), (1e-4, 1e-7)][int(rng.integers(2))]
        data = dict(hours=start + t, cap=cap, demand=demand, tau=tau, theta=theta, r=r)
        args = {k: traced(v) for k, v in data.items()}
        ts = start + t[1:]
        written = Written(rate, x0, float(hours), list(t), accuracy=accuracy_for(rtol))
        return Sample(args, jnp.asarray(x0), start, start + hours, ts, rtol, atol, written)

    return Family(f"dispatch of {units} units over {hours} h", methods, problem, draw, samples)
