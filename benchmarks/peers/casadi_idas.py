"""The races for CasADi's IDAS: differential-algebraic systems, whose algebraic equation is the natural
map y = Π(y − F(y)) of the law. CasADi is imported where it is asked for: it is not installed by this
project."""

import importlib.util
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np


class System(NamedTuple):
    """x' = `rate`, 0 = `law` in CasADi's symbols, from x0 and a y that nearly solves the law."""

    t: Any
    x: Any
    y: Any
    rate: Any
    law: Any
    x0: np.ndarray
    y0: np.ndarray
    end: float


def present() -> bool:
    return importlib.util.find_spec("casadi") is not None


def _symbols(n: int) -> tuple[Any, Any, Any]:
    import casadi

    return casadi.SX.sym("t"), casadi.SX.sym("x", n), casadi.SX.sym("y", n)


def contact(n: int) -> System:
    import casadi

    t, x, y = _symbols(n)
    law = y - casadi.fmin(casadi.fmax(y - (2.0 * y - 1.0 + 2.0 * x), 0.0), 0.5)
    return System(t, x, y, 3.0 - 1.5 * x - y, law, np.array([-1.0]), np.array([0.5]), 2.0)


def moving_box(n: int) -> System:
    import casadi

    t, x, y = _symbols(n)
    inverse = np.linalg.inv(np.array([[2.0, 0.5], [0.5, 1.0]]))
    low = casadi.vertcat(-5.0, -1.0 + 0.25 * casadi.cos(2.0 * t))
    up = casadi.vertcat(1.0 + 0.5 * casadi.sin(t), 5.0)
    force = casadi.mtimes(1.5 * inverse, y) - 0.2 * x - np.array([4.0, -4.0])
    law = y - casadi.fmin(casadi.fmax(y - force, low), up)
    rate = casadi.mtimes(np.array([[-1.0, 2.0], [-2.0, -1.0]]), x) + np.array([1.0, 0.0])
    rate -= np.array([1.0, 0.5]) * casadi.mtimes(inverse, y)
    return System(t, x, y, rate, law, np.array([0.3, -0.2]), np.array([1.0, -0.75]), 4.0)


def shrinking_ball(n: int) -> System:
    import casadi

    t, x, y = _symbols(n)
    radius = 0.5 * casadi.exp(-0.5 * t)
    moved = y - (2.0 * y - 2.0 * x)
    law = y - moved * casadi.fmin(1.0, radius / casadi.norm_2(moved))
    rate = casadi.mtimes(np.array([[-0.5, -3.0], [3.0, -0.5]]), x) - y
    return System(t, x, y, rate, law, np.array([2.0, 0.0]), np.array([0.5, 0.0]), 4.0)


def heat(n: int) -> System:
    import casadi

    t, x, y = _symbols(n)
    width = np.pi / n
    s = (np.arange(n) + 0.5) * width
    wide = casadi.vertcat(-x[0], x, -x[n - 1])
    second = (wide[:-2] - 2.0 * x + wide[2:]) / width**2
    wave = casadi.exp(-t) * np.sin(s)
    bound = lambda v: casadi.fmin(casadi.fmax(v, 0.0), 0.4)  # noqa: E731
    rate = second + 0.2 * wave + bound((1.0 - 1.5 * wave) / 1.5) - 0.2 * x - y
    law = y - bound(y - (1.5 * y - 1.0 + 1.5 * x))
    x0 = np.sin(s) + 0.3 * np.sin(2.0 * s)
    return System(t, x, y, rate, law, x0, np.clip((1.0 - 1.5 * x0) / 1.5, 0.0, 0.4), 1.0)


SYSTEMS = {
    "contact": contact, "moving_box": moving_box, "shrinking_ball": shrinking_ball, "heat": heat,
}  # fmt: skip


def idas(system: System) -> Callable[[float], np.ndarray]:
    """rtol -> x(end), NaN where IDAS gives up. Its linear systems are solved by CasADi's sparse
    factorisation; an integrator is made once for every rtol."""
    import casadi

    dae = {"x": system.x, "z": system.y, "t": system.t, "ode": system.rate, "alg": system.law}
    made: dict[float, Any] = {}

    def solve(rtol: float) -> np.ndarray:
        if rtol not in made:
            options = {
                "reltol": rtol, "abstol": 1e-3 * rtol, "max_num_steps": 1_000_000, "calc_ic": True,
                "newton_scheme": "direct", "disable_internal_warnings": True,
                "show_eval_warnings": False,
            }  # fmt: skip
            made[rtol] = casadi.integrator("race", "idas", dae, 0.0, system.end, options)
        try:
            return np.asarray(made[rtol](x0=system.x0, z0=system.y0)["xf"]).ravel()
        except RuntimeError:
            return np.full_like(system.x0, np.nan)

    return solve
