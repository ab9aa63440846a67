"""The cost of a derivative relative to the plain solve, in reverse and in forward mode."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..clock import in_turn, timed
from ..contact_law import ContactLaw, strip
from ..peers import hand_fused
from ..section import Section, compare
from ..workloads import conduction

_END = 2.0
_LETTERS = ("alpha", "b_x", "b_u", "d_x", "d_u", "ell")
_DIFFERENCE = 1e-5
_MOST_STEPS = 2**12


def run(full: bool) -> Section:
    section = Section(
        title="derivatives: of the sum of x(2) with respect to six parameters",
        fair=(
            "All under jax.jit. The other side is the plain solve of the same problem with the "
            "same steps. Reverse is jax.grad of all six parameters at once; forward is jax.jvp in "
            'one direction (ℓ); "x0 alone" is jax.grad of the initial state. The first error is that '
            "of the derivative with respect to ℓ, or of the sum of that with respect to x0, relative, "
            "against central differences of the closed form (their own error is about 1e-10); with "
            "fixed steps it is the error of the steps. The second is that "
            "of x(2), and beside what is written by hand that of its derivative. By hand are the "
            "fused ETD2RK step in a scan under jax.grad, with respect to b_x, d_x and ℓ or to x0, all "
            "states kept, and in a loop under jax.jvp in ℓ. Of the sparse matrix the derivative is "
            "that in all entries, and its error that beside central differences of plain solves."
        ),
    )
    rounds = 15 if full else 7
    for points, settings in (
        (2, {"dt": _END / 1000}),
        (2, {"rtol": 1e-6, "atol": 1e-9}),
        (10**3, {"dt": _END / 1000}),
        (10**5, {"dt": _END / 100}),
    ):
        _measure(section, strip(points), settings, rounds)
    for side in (64, 256) if full else (64,):
        _matrix(section, side, rounds)
    return section


def _matrix(section: Section, side: int, rounds: int) -> None:
    """The derivative in the entries of a sparse matrix, all proportional to a rate."""
    problem, rate, x0 = conduction(side)
    start, end, steps = jnp.asarray(x0), 0.1, 20

    def mean(rate: Any) -> Any:
        return jnp.mean(dvax.solve(problem, start, 0.0, end, rate, dt=end / steps).xs[-1])

    plain, reverse = jax.jit(mean), jax.jit(jax.grad(mean))
    change = 1e-4 * rate
    difference = (plain(rate + change) - plain(rate - change)) / (2.0 * change)
    sides = {
        name: timed(lambda run=run: jax.block_until_ready(run(rate)))
        for name, run in (("plain", plain), ("reverse", reverse))
    }
    taken = in_turn(sides, rounds)
    section.comparisons.append(
        compare(f"sparse matrix, n = {side**2}, {steps} steps, reverse", "plain solve",
                taken["reverse"], taken["plain"],
                error=abs(float(reverse(rate) / difference) - 1.0))
    )  # fmt: skip


def _measure(section: Section, law: ContactLaw, settings: dict[str, Any], rounds: int) -> None:
    parameters = {name: jnp.asarray(getattr(law, name)) for name in _LETTERS}
    along = {name: jnp.asarray(1.0 if name == "ell" else 0.0) for name in _LETTERS}
    problem, start = _problem(law), jnp.asarray(law.start)

    def end(p: dict[str, Any], adjoint: str, start: Any = start) -> Any:
        return dvax.solve(
            problem, start, 0.0, _END, p, adjoint=adjoint, max_steps=_MOST_STEPS, **settings
        ).xs[-1]

    plain = jax.jit(lambda p: end(p, "reverse"))
    reverse = jax.jit(jax.grad(lambda p: jnp.sum(end(p, "reverse"))))
    by_start = jax.jit(jax.grad(lambda x: jnp.sum(end(parameters, "reverse", x))))
    forward = jax.jit(lambda p: jax.jvp(lambda q: jnp.sum(end(q, "forward")), (p,), (along,))[1])

    exact = _sum_along(law, "ell")
    exact_by_start = _sum_along(law, "x0")
    errors = {
        "reverse": abs(float(reverse(parameters)["ell"]) / exact - 1.0),
        "reverse, x0 alone": abs(float(jnp.sum(by_start(start))) / exact_by_start - 1.0),
        "forward": abs(float(forward(parameters)) / exact - 1.0),
    }
    of_x = law.error(plain(parameters), _END)

    def blocked(run: Callable[[Any], Any]) -> Callable[[], Any]:
        return lambda: jax.block_until_ready(run(parameters))

    sides = {
        name: blocked(run)
        for name, run in (("plain", plain), ("reverse", reverse), ("forward", forward))
    }
    sides["reverse, x0 alone"] = lambda: jax.block_until_ready(by_start(start))
    fixed = "dt" in settings
    by_hand, errors_by_hand = _by_hand(law, settings, exact, exact_by_start) if fixed else ({}, {})
    sides |= {f"{name}, by hand": lambda run=run: run(start) for name, run in by_hand.items()}
    taken = in_turn({name: timed(side) for name, side in sides.items()}, rounds)
    steps = f"{round(_END / settings['dt'])} steps" if fixed else f"rtol {settings['rtol']:g}"
    for name in errors:
        section.comparisons.append(
            compare(f"n = {law.g.size}, {steps}, {name}", "plain solve", taken[name],
                    taken["plain"], error=errors[name], error_other=of_x,
                    target=("≤", 2.5 if name == "forward" else 4.0))
        )  # fmt: skip
    for name in by_hand:
        section.comparisons.append(
            compare(f"n = {law.g.size}, {steps}, {name}", "the same by hand", taken[name],
                    taken[f"{name}, by hand"], error=errors[name], error_other=errors_by_hand[name])
        )  # fmt: skip


def _by_hand(
    law: ContactLaw, settings: dict[str, Any], exact: float, exact_by_start: float
) -> tuple[dict[str, Callable[[Any], Any]], dict[str, float]]:
    """What JAX makes of a loop without a library, and its errors."""
    given = law, settings["dt"], round(_END / settings["dt"])
    runs = {
        "reverse": hand_fused.gradient(*given),
        "reverse, x0 alone": hand_fused.gradient_by_start(*given),
        "forward": hand_fused.tangent(*given),
    }
    start = jnp.asarray(law.start)
    return runs, {
        "reverse": abs(float(runs["reverse"](start)["ell"]) / exact - 1.0),
        "reverse, x0 alone": abs(
            float(jnp.sum(runs["reverse, x0 alone"](start))) / exact_by_start - 1.0
        ),
        "forward": abs(float(runs["forward"](start)) / exact - 1.0),
    }


def _problem(law: ContactLaw) -> dvax.Problem:
    g = jnp.asarray(law.g)
    return dvax.Problem(
        A=lambda p: dvax.generators.Scalar(-p["alpha"]),
        P=dvax.operators.Scaling(law.beta),
        K=dvax.sets.Box(0.0, law.kappa0),
        f=lambda t, x, u, p: p["ell"] - p["d_x"] * x - p["d_u"] * u,
        h=lambda t, x, u, p: g - p["b_x"] * x - p["b_u"] * u,
    )


def _sum_along(law: ContactLaw, name: str) -> float:
    """The derivative of Σ x(2) where `name` grows at every point alike, by central differences of the
    closed form."""
    at = getattr(law, name)
    up = replace(law, **{name: at + _DIFFERENCE}).exact(_END)
    down = replace(law, **{name: at - _DIFFERENCE}).exact(_END)
    return float(np.sum(up - down)) / (2 * _DIFFERENCE)
