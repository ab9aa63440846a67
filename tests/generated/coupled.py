"""Generated problems whose law is not a projection, whose u and x differ in shape, or with tuples."""

from typing import Any

import jax.numpy as jnp
import numpy as np

import dvax

from . import projections as by_hand
from .family import (
    ALL,
    Family,
    Sample,
    accuracy_for,
    span_and_start,
    times_of,
    tolerance,
    traced,
    unit,
)
from .profiles import PROFILES
from .reference import Written


def _with(profiles: dict[str, Any], rng: Any, t0: float, length: float) -> tuple[Any, Any, Any]:
    """(numbers of the profiles for dvax, for NumPy, and the breaks of all)."""
    there = {k: v.shifted(v.draw(rng, length), t0) for k, v in profiles.items()}
    here = {k: v.shifted(there[k], -t0) for k, v in profiles.items()}
    breaks = [t for k, v in profiles.items() for t in v.breaks(here[k], length)]
    breaks += list(length * np.arange(1, 8) / 8.0)
    given = {k: {name: traced(v) for name, v in of.items()} for k, of in there.items()}
    return given, here, breaks


def full_matrix(
    m: int, motion: str, *, h: str = "nothing", methods: Any = ALL, samples: int = 160
) -> Family:
    """0 ∈ M u − q(t) + G x + N_K(u) on a box, M not symmetric, x' = −a x + b u: face by face."""
    E, H = PROFILES[motion], PROFILES[h]
    problem = dvax.Problem(
        A=lambda args: dvax.generators.Scalar(-args["a"]),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(args["low"], args["up"] * (1.0 - E.of(args["E"])(t))),
        f=lambda t, x, u, args: args["b"] * u,
        h=lambda t, x, u, args: (
            args["q"] + args["e_h"] * H.of(args["H"])(t) + u - args["M"] @ u - args["G"] @ x
        ),
        state_space=dvax.spaces.Euclidean(m),
        control_space=dvax.spaces.Euclidean(m),
    )

    def draw(rng: Any) -> Sample:
        t0, length = span_and_start(rng)
        given, p, breaks = _with({"E": E, "H": H}, rng, t0, length)
        S, skew = 0.5 * rng.normal(size=(m, m)), 0.7 * rng.normal(size=(m, m))
        M = S @ S.T + skew - skew.T + np.eye(m)
        G = 0.5 * rng.normal(size=(m, m)) / np.sqrt(m)
        a, b = rng.uniform(0.0, 1.0) / length, rng.uniform(0.3, 1.0) / length
        low, up = -rng.uniform(0.2, 1.5, m), rng.uniform(0.2, 1.5, m)
        q, e_h, x0 = 2.0 * rng.normal(size=m), 2.0 * unit(rng, m), rng.normal(size=m)
        faces = by_hand.faces_of_box(M)

        def rate(s: float, x: Any) -> Any:
            z = q + e_h * H.value(np, s, p["H"]) - G @ x
            u = by_hand.affine_box(z, faces, low, up * (1.0 - E.value(np, s, p["E"])))
            return -a * x + b * u

        rtol, atol = tolerance(rng, t0, t0 + length, 10.0)
        data = dict(M=M, G=G, a=a, b=b, low=low, up=up, q=q, e_h=e_h)
        args = {**{k: traced(v) for k, v in data.items()}, **given}
        written = Written(rate, x0, length, breaks, accuracy=accuracy_for(rtol))
        ts = times_of(rng, length, breaks, t0)
        return Sample(args, jnp.asarray(x0), t0, t0 + length, ts, rtol, atol, written)

    name = f"Box of {m} with a full matrix, K {motion}" + (f", h {h}" if h != "nothing" else "")
    return Family(name, methods, problem, draw, samples)


def scaled_control(motion: str, h: str = "nothing", methods: Any = ALL) -> Family:
    """u ∈ q − g x − c u − N_K(P u), P diagonal, K a box: P u = clip(P(q − g x)/(1 + c))."""
    E, H, m = PROFILES[motion], PROFILES[h], 3
    problem = dvax.Problem(
        A=lambda args: dvax.generators.Diagonal(-args["a"]),
        P=lambda args: dvax.operators.Diagonal(args["P"]),
        K=lambda t, args: dvax.sets.Box(args["low"], args["up"] * (1.0 - E.of(args["E"])(t))),
        f=lambda t, x, u, args: args["b"] * u,
        h=lambda t, x, u, args: args["q"] + args["e_h"] * H.of(args["H"])(t) - args["g"] * x
        - args["c"] * u,
        state_space=dvax.spaces.Euclidean(m),
        control_space=dvax.spaces.Euclidean(m),
    )  # fmt: skip

    def draw(rng: Any) -> Sample:
        t0, length = span_and_start(rng)
        given, p, breaks = _with({"E": E, "H": H}, rng, t0, length)
        P, a = rng.uniform(0.3, 3.0, m), 10.0 ** rng.uniform(-1.0, 2.0, m) / length
        b, c, g = rng.uniform(0.3, 3.0) / length, rng.uniform(0.0, 1.0), rng.uniform(0.0, 5.0)
        low, up = -rng.uniform(0.2, 1.5, m), rng.uniform(0.2, 1.5, m)
        q, e_h, x0 = 2.0 * rng.normal(size=m), 2.0 * unit(rng, m), rng.normal(size=m)

        def rate(s: float, x: Any) -> Any:
            z = P * (q + e_h * H.value(np, s, p["H"]) - g * x) / (1.0 + c)
            return -a * x + b / P * np.clip(z, low, up * (1.0 - E.value(np, s, p["E"])))

        rtol, atol = tolerance(rng, t0, t0 + length, 10.0)
        data = dict(P=P, a=a, b=b, c=c, g=g, low=low, up=up, q=q, e_h=e_h)
        args = {**{k: traced(v) for k, v in data.items()}, **given}
        written = Written(rate, x0, length, breaks, accuracy=accuracy_for(rtol))
        ts = times_of(rng, length, breaks, t0)
        return Sample(args, jnp.asarray(x0), t0, t0 + length, ts, rtol, atol, written)

    name = f"Box seen through P, K {motion}" + (f", h {h}" if h != "nothing" else "")
    return Family(name, methods, problem, draw)


def curved(kind: str, motion: str, methods: Any = ALL) -> Family:
    """Laws that are not affine in u, on an interval: u + c tanh u = z, and (2 + sin u)(u − z)."""
    E = PROFILES[motion]

    def z_of(lib: Any, t: Any, x: Any, args: Any) -> Any:
        wave = args["w"] * lib.sin(args["omega"] * (t - args["start"]))
        return args["q"] + wave - args["g"] * x

    law = {
        "tanh": lambda t, x, u, args: z_of(jnp, t, x, args) - args["c"] * jnp.tanh(u),
        "weighted": lambda t, x, u, args: u - (2.0 + jnp.sin(u)) * (u - z_of(jnp, t, x, args)),
    }[kind]
    problem = dvax.Problem(
        A=lambda args: dvax.generators.Scalar(-args["a"]),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(-args["up"], args["up"] * (1.0 - E.of(args["E"])(t))),
        f=lambda t, x, u, args: args["b"] * u,
        h=law,
    )

    def draw(rng: Any) -> Sample:
        t0, length = span_and_start(rng)
        given, p, breaks = _with({"E": E}, rng, t0, length)
        data = dict(
            a=rng.uniform(0.0, 1.0) / length, b=rng.uniform(0.3, 2.0) / length, c=rng.uniform(0.2, 3.0),
            g=rng.uniform(0.0, 3.0), q=rng.normal(), w=rng.uniform(0.0, 0.5),
            omega=rng.uniform(1.0, 10.0) / length, start=t0, up=rng.uniform(0.3, 1.5),
        )  # fmt: skip
        data = {k: float(v) for k, v in data.items()}
        here = {**data, "start": 0.0}

        def rate(s: float, x: Any) -> Any:
            u = z = float(z_of(np, s, x[0], here))
            if kind == "tanh":
                u = z / (1.0 + here["c"])
                for _ in range(50):  # u + c tanh u is concave for u > 0: Newton's method climbs
                    th = np.tanh(u)
                    step = (z - u - here["c"] * th) / (1.0 + here["c"] * (1.0 - th * th))
                    u += step
                    if abs(step) <= 1e-15 * (1.0 + abs(u)):
                        break
            up = here["up"]
            return -here["a"] * x + here["b"] * np.clip(u, -up, up * (1.0 - E.value(np, s, p["E"])))

        rtol, atol = tolerance(rng, t0, t0 + length, 10.0)
        x0 = rng.normal(size=1)
        written = Written(rate, x0, length, breaks, accuracy=accuracy_for(rtol))
        ts = times_of(rng, length, breaks, t0)
        return Sample(
            {**data, **given}, jnp.asarray(x0[0]), t0, t0 + length, ts, rtol, atol, written
        )

    return Family(f"Box with a {kind} law, K {motion}", methods, problem, draw)


def oscillator(motion: str, h: str = "nothing", methods: Any = ALL) -> Family:
    """A mass on a spring that a saturated controller damps: two states, one control."""
    E, H = PROFILES[motion], PROFILES[h]
    problem = dvax.Problem(
        A=lambda args: dvax.generators.Dense(args["A"]),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(-args["up"], args["up"] * (1.0 - E.of(args["E"])(t))),
        f=lambda t, x, u, args: jnp.stack([0.0 * u, args["b"] * u]),
        h=lambda t, x, u, args: args["q"] + args["e_h"] * H.of(args["H"])(t) - args["k"] * x[1],
        state_space=dvax.spaces.Euclidean(2),
        control_space=dvax.spaces.Euclidean(),
    )

    def draw(rng: Any) -> Sample:
        t0, length = span_and_start(rng)
        given, p, breaks = _with({"E": E, "H": H}, rng, t0, length)
        w, damping = rng.uniform(2.0, 20.0) / length, rng.uniform(0.0, 0.5)
        A = w * np.array([[0.0, 1.0], [-1.0, -2.0 * damping]])
        data = dict(b=w, k=rng.uniform(0.1, 5.0), q=rng.normal(), e_h=2.0 * rng.normal())
        data["up"] = rng.uniform(0.2, 1.5)
        data = {name: float(v) for name, v in data.items()}
        q, k, e_h, up = data["q"], data["k"], data["e_h"], data["up"]

        def rate(s: float, x: Any) -> Any:
            z = q + e_h * H.value(np, s, p["H"]) - k * x[1]
            u = np.clip(z, -up, up * (1.0 - E.value(np, s, p["E"])))
            return A @ x + np.array([0.0, w * u])

        rtol, atol = tolerance(rng, t0, t0 + length, 10.0)
        x0 = rng.normal(size=2)
        written = Written(rate, x0, length, breaks, accuracy=accuracy_for(rtol))
        ts = times_of(rng, length, breaks, t0)
        args = {"A": jnp.asarray(A), **data, **given}
        return Sample(args, jnp.asarray(x0), t0, t0 + length, ts, rtol, atol, written)

    name = f"oscillator, K {motion}" + (f", h {h}" if h != "nothing" else "")
    return Family(name, methods, problem, draw)


def pair(motion: str, h: str = "nothing", methods: Any = ALL) -> Family:
    """States of two parts, each with a set of its own: a box and a ball."""
    E, H = PROFILES[motion], PROFILES[h]
    spaces = dvax.spaces.Product(dvax.spaces.Euclidean(2), dvax.spaces.Euclidean(2))
    problem = dvax.Problem(
        A=dvax.generators.Product(dvax.generators.Scalar(-1.0), dvax.generators.Zero()),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Product(
            dvax.sets.Box(-args["up"], args["up"]),
            dvax.sets.Ball(0.0, args["r"] * (1.0 - E.of(args["E"])(t))),
        ),
        f=lambda t, x, u, args: (args["b"] * u[0], args["b"] * (u[1] + 0.2 * u[0]) - 0.1 * x[1]),
        h=lambda t, x, u, args: (
            args["q"][0] + args["e_h"] * H.of(args["H"])(t) - x[0],
            args["q"][1] - args["g"] * x[1] - u[1],
        ),
        state_space=spaces,
        control_space=spaces,
    )

    def draw(rng: Any) -> Sample:
        t0, length = span_and_start(rng)
        given, p, breaks = _with({"E": E, "H": H}, rng, t0, length)
        b, g, r, up = (float(v) for v in rng.uniform(0.3, 1.0, 4))
        b /= length
        q, e_h = rng.normal(size=(2, 2)), 2.0 * unit(rng, 2)

        def rate(s: float, x: Any) -> Any:
            first = np.clip(q[0] + e_h * H.value(np, s, p["H"]) - x[:2], -up, up)
            other = 0.5 * (q[1] - g * x[2:])
            other = by_hand.ball(other, 0.0, r * (1.0 - E.value(np, s, p["E"])))
            return np.concatenate([-x[:2] + b * first, b * (other + 0.2 * first) - 0.1 * x[2:]])

        rtol, atol = tolerance(rng, t0, t0 + length, 10.0)
        x0 = rng.normal(size=4)
        written = Written(rate, x0, length, breaks, accuracy=accuracy_for(rtol))
        ts = times_of(rng, length, breaks, t0)
        args = dict(b=b, g=g, r=r, up=up, q=jnp.asarray(q), e_h=jnp.asarray(e_h), **given)
        start = (jnp.asarray(x0[:2]), jnp.asarray(x0[2:]))
        return Sample(args, start, t0, t0 + length, ts, rtol, atol, written)

    name = f"Product, K {motion}" + (f", h {h}" if h != "nothing" else "")
    return Family(name, methods, problem, draw)
