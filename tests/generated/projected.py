"""Laws that are solved by a projection onto a set, which any profile moves.

    x' = A x + b u + e_f F(t),      u ∈ q(t) + e_h H(t) − g x − c u − N_{K(t)}(u)

so that u = proj_{K(t)}((q + e_h H − g x)/(1 + c)): by dvax as it finds it, by NumPy as it is written.
q turns slowly; K shrinks or moves with a profile E, and E, F, H are those of `profiles`. Trajectories
approach each other, since b, g ≥ 0 and a projection is monotone: errors are not amplified.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

import dvax

from .family import (
    ALL,
    Array,
    Family,
    Sample,
    accuracy_for,
    span_and_start,
    times_of,
    tolerance,
    traced,
    unit,
)
from .profiles import PROFILES, Numbers
from .reference import Written
from .sets import SETS

LONG = ("waves", "a hundred waves", "squares")
"""Profiles whose periods are too many for SciPy: it stops where one is like the one before."""


def projected(
    set_name: str,
    motion: str = "nothing",
    *,
    f: str = "nothing",
    h: str = "nothing",
    generator: str = "Zero",
    feedback: bool = True,
    gain: tuple[float, float] = (0.1, 10.0),
    methods: tuple[str, ...] = ALL,
    span: tuple[float, float] | None = None,
    samples: int = 160,
) -> Family:
    """The family of a set that moves by `motion`, with the profiles `f` and `h` in the data."""
    kind = SETS[set_name]
    m = kind.size
    E, F, H = PROFILES[motion], PROFILES[f], PROFILES[h]
    periodic = any(name in LONG for name in (motion, f, h))
    stiff = gain[1] > 1e3
    scalar = m == 0
    shape = () if scalar else (m,)

    def generator_of(args: Any) -> Any:
        a = args["A"]
        if generator == "Zero":
            return dvax.generators.Zero()
        if generator == "Scalar":
            return dvax.generators.Scalar(a)
        return {"Diagonal": dvax.generators.Diagonal, "Dense": dvax.generators.Dense}[generator](a)

    def drift(lib: Any, x: Any) -> Any:
        return -0.1 * x if generator == "Zero" else 0.0 * x

    def rate(t: Any, x: Any, u: Any, args: Any) -> Any:
        return args["b"] * u + args["e_f"] * F.of(args["F"])(t) + drift(jnp, x)

    def law(t: Any, x: Any, u: Any, args: Any) -> Any:
        slow = args["q0"] + args["q1"] * jnp.sin(args["omega"] * (t - args["start"]))
        drive = slow + args["e_h"] * H.of(args["H"])(t)
        return drive - (args["g"] * x if feedback else 0.0 * x) - args["c"] * u

    problem = dvax.Problem(
        A=generator_of,
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: kind.make(args["K"], E.of(args["E"])(t)),
        f=rate,
        h=law,
        state_space=dvax.spaces.Euclidean(shape),
        control_space=dvax.spaces.Euclidean(shape),
    )

    def draw(rng: np.random.Generator) -> Sample:
        t0, length = span_and_start(rng)
        if span is not None:
            t0, length = (0.0 if rng.random() < 0.5 else t0), float(rng.uniform(*span))
            length = (t0 + length) - t0
        t1 = t0 + length
        g = float(np.exp(rng.uniform(*np.log(gain)))) if feedback else 0.0
        n = max(m, 1)
        c, b = float(rng.uniform(0.0, 1.0)), float(rng.uniform(0.3, 1.0)) / min(length, 10.0)
        A = _matrix(rng, generator, n) / min(length, 10.0)
        profiles = (("E", E), ("F", F), ("H", H))
        moved = {name: profile.shifted(profile.draw(rng, length), t0) for name, profile in profiles}
        p = {name: profile.shifted(moved[name], -t0) for name, profile in profiles}
        size = rng.uniform(0.2, 1.2)
        some = lambda: unit(rng, n)  # noqa: E731
        q0 = size * some() * (1.0 + c)
        q1 = 0.0 * q0 if periodic or rng.random() < 0.4 else rng.uniform(0.0, 0.5) * some()
        x0 = rng.normal(size=n) * (0.5 if g < 10 else 0.5 / g * 10)
        if g > 1.0:
            # The set point is what the drive asks for: x follows q/g.
            q0, q1 = q0 * min(g, 1e3) ** rng.uniform(0.0, 1.0), q1 * g ** rng.uniform(0.0, 1.0)
        omega = float(rng.uniform(0.5, 6.0)) / length
        e_f, e_h = rng.normal() * some() * 3.0 * b, rng.normal() * some() * 2.0 * (1.0 + c)
        K = kind.draw(rng)
        matrix = A if A.ndim == 2 else np.diag(A) if A.ndim == 1 else A * np.eye(n)
        if generator == "Zero":
            matrix = -0.1 * np.eye(n)
        value = {name: profile.value for name, profile in profiles}

        def by_hand(s: float, x: Array) -> Array:
            drive = q0 + q1 * np.sin(omega * s) + e_h * value["H"](np, s, p["H"])
            u = kind.project((drive - g * x) / (1.0 + c), K, value["E"](np, s, p["E"]))
            return matrix @ x + b * u + e_f * value["F"](np, s, p["F"])

        breaks = [t for name, profile in profiles for t in profile.breaks(p[name], length)]
        period = _period(p, periodic)
        if period is not None:
            breaks = sorted({round(t % period, 12) for t in breaks[: 4 * 8]})
            breaks += list(period * np.arange(1, 8) / 8.0)
        else:
            breaks += list(length * np.arange(1, 8) / 8.0)
        features = breaks if period is None else [period * k for k in range(1, 7)]
        rtol, atol = tolerance(rng, t0, t1, 10.0, tight=not stiff)
        if periodic:
            # The defect of a step is held below the tolerance over the whole span.
            rtol, atol = (
                (1e-4, 1e-7) if "default" not in methods and rng.random() < 0.5 else (1e-3, 1e-6)
            )
        flat = lambda v: jnp.asarray(v[0] if scalar else v)  # noqa: E731
        moved = {name: {key: traced(v) for key, v in of.items()} for name, of in moved.items()}
        args = {
            "A": jnp.asarray(A[0, 0] if scalar and A.ndim == 2 else A),
            "K": {k: traced(v) for k, v in K.items()},
            "b": b, "c": c, "g": g, "omega": omega, "start": t0,
            "q0": flat(q0), "q1": flat(q1), "e_f": flat(e_f), "e_h": flat(e_h), **moved,
        }  # fmt: skip
        ts = times_of(rng, length, features, t0)
        written = Written(
            by_hand, x0, length, breaks, period, stiff and g > 300, accuracy_for(rtol)
        )
        return Sample(args, flat(x0), t0, t1, ts, rtol, atol, written)

    parts = [
        set_name,
        *(
            f"{where} {what}"
            for where, what in (("K", motion), ("f", f), ("h", h))
            if what != "nothing"
        ),
    ]
    parts += [generator] if generator != "Zero" else []
    parts += ["open loop"] if not feedback else ["stiff"] if stiff else []
    return Family(", ".join(parts), methods, problem, draw, samples)


def _period(p: dict[str, Numbers], periodic: bool) -> float | None:
    """The common period of the data, if there is one."""
    widths = [v["w"] for v in p.values() if "w" in v]
    return float(widths[0]) if periodic and len(widths) == 1 else None


def _matrix(rng: Any, generator: str, n: int) -> Array:
    """The matrix of a contraction: dissipative in the Euclidean norm."""
    if generator == "Diagonal":
        return -(10.0 ** rng.uniform(-1.0, 3.0, n))
    if generator == "Dense":
        skew = rng.normal(size=(n, n))
        root = rng.normal(size=(n, n))
        return 3.0 * (skew - skew.T) - 0.3 * root @ root.T - 0.1 * np.eye(n)
    return np.asarray(-float(rng.uniform(0.05, 3.0)))
