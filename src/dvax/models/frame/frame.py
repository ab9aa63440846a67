"""A one-storey frame that yields, shaken by an earthquake."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ... import _tree
from ...errors import InputError, Problems
from ...evolution import ExpRosenbrock, PiecewiseLinear, Solution, solve
from ...generators import Dense
from ...operators import Scaling
from ...problem import Problem
from ...sets import Box
from ...spaces import L2, Euclidean
from ...theory import Constants
from .accelerogram import Accelerogram
from .peaks import largest

_BETWEEN = 8
"""Times in a step of the record at which a run is saved."""


class Frame(eqx.Module):
    """An oscillator whose spring is viscoplastic, after Duvaut and Lions, on moving ground.

        d'' = −2ζω d' − ω²(d − d_p) − a_g(t),            ω = 2π/T
        d_p' = ((d − d_p) − u)/τ,    u = proj_K(d − d_p),    K = [−d_y, d_y],    τ = η/k

    d is the displacement against the ground, d_p its plastic part (in); k(d − d_p) is the force of the
    spring; k u is the part of it that the yield force f_y = k d_y bears, and what is above drives the
    plastic flow. The state is x = (d, d', d_p), ‖x‖² = (ωd)² + d'² + (ωd_p)², A all that is linear:

        A = [[0, 1, 0], [−ω², −2ζω, ω²], [1/τ, 0, −1/τ]],  f = (0, −a_g(t), −u/τ),  h = d − d_p,  P = 1.

    **Arguments:** `record`, the ground's `Accelerogram`; `period` T in s; `damping` ζ, of the critical;
    `yield_ratio` = f_y / (largest elastic force), or else `yield_displacement` d_y in in; None of
    them for a frame that stays elastic; `viscosity_ratio` τ = η/k in s, for one that does not.

    **What is exact.** The viscoplastic frame is in the class, with γ = L_F = 1. As a frame that is
    elastoplastic it is regularised: its displacement is off by O(η/k), which `elastoplastic_distance`
    bounds. The cost does not grow as η/k → 0.

    **Raises:** `dvax.InputError` for every argument that breaks its rule.

    **Source:** Duvaut and Lions (1976), Chapter V; Chopra (1995), Sections 6.4 and 7.1 to 7.5.

    ```python
    >>> import numpy as np
    >>> from dvax.models import Accelerogram, Frame
    >>> push = Accelerogram(0.1, 0.3 * np.sin(np.arange(31)))
    >>> frame = Frame(record=push, period=0.7, damping=0.05, yield_ratio=0.5, viscosity_ratio=0.01)
    >>> {name: round(value, 3) for name, value in frame.figures().items()}
    {'peak_displacement': 4.621, 'largest_displacement': 4.621, 'yield_displacement': 3.298}

    ```
    """

    record: Accelerogram
    period: jax.Array
    damping: jax.Array
    yield_displacement: jax.Array
    viscosity_ratio: jax.Array

    def __init__(
        self,
        *,
        record: Any,
        period: Any,
        damping: Any,
        yield_ratio: Any = None,
        yield_displacement: Any = None,
        viscosity_ratio: Any = None,
    ):
        given = {
            "period": period, "damping": damping, "yield_ratio": yield_ratio,
            "yield_displacement": yield_displacement, "viscosity_ratio": viscosity_ratio,
        }  # fmt: skip
        values = _checked(record, given)
        self.record = record
        self.period, self.damping = values["period"], values["damping"]
        # A frame that does not yield flows at no rate, whatever it is divided by.
        flow = values.get("viscosity_ratio")
        self.viscosity_ratio = jnp.ones_like(self.period) if flow is None else flow
        limit = values.get("yield_displacement")
        if "yield_ratio" in values:
            elastic = Frame(record=record, period=period, damping=damping)
            limit = values["yield_ratio"] * elastic.largest_displacement(elastic.solve())
        self.yield_displacement = jnp.full_like(self.period, jnp.inf) if limit is None else limit

    @property
    def omega(self) -> Any:
        """ω = 2π/T (1/s)."""
        return 2.0 * np.pi / self.period

    @property
    def fit(self) -> str:
        """How the frame stands to the class."""
        if _tree.is_concrete(self.yield_displacement) and np.all(np.isinf(self.yield_displacement)):
            return "exact"
        return (
            f"regularised by η/k = {_tree.short(self.viscosity_ratio)} s: an elastoplastic frame as it "
            "goes to 0; exact as the viscoplastic frame that it is"
        )

    @property
    def problem(self) -> Problem:
        """The coupled system."""
        w, rate = self.omega, 1.0 / self.viscosity_ratio
        zero, one = jnp.zeros_like(w), jnp.ones_like(w)
        A = jnp.stack(
            [
                jnp.stack([zero, one, zero]),
                jnp.stack([-(w**2), -2.0 * self.damping * w, w**2]),
                jnp.stack([rate, zero, -rate]),
            ]
        )
        return Problem(
            A=Dense(A),
            P=Scaling(1.0),
            K=Box(-self.yield_displacement, self.yield_displacement),
            f=_Rate(self.record, rate),
            h=_Elastic(),
            state_space=L2(jnp.stack([w**2, one, w**2])),
            control_space=Euclidean(1),
        )

    @property
    def constants(self) -> Constants:
        """γ = L_F = 1, α_h = √2/ω, β_h = 0, α_f = 0, β_f = ω/τ, M = 1 and ω_A from A; and, since

            V = ½(ω(d − d_p))² + ½d'² + ½ε(ωd)²,   V' ≤ −2ζω d'² + εω² d d' ≤ 2μV

        for the difference of two trajectories (a projection being monotone), with μ = ½ω min(√ε, ε/4ζ),
        `energy` = (M, μ), M² the condition of V in the norm of x, and √ε = 2/(ω · duration)."""
        w, z, tau = (float(v) for v in (self.omega, self.damping, self.viscosity_ratio))
        root = np.array([w, 1.0, w])
        A = np.array([[0.0, 1.0, 0.0], [-w * w, -2.0 * z * w, w * w], [1 / tau, 0.0, -1 / tau]])
        scaled = root[:, None] * A / root
        small = (2.0 / (w * self.record.duration)) ** 2
        # V in the norm of x has the eigenvalues 1 and s± = (2 + ε ± √(ε² + 4))/2, with s₊s₋ = ε.
        largest_V = 0.5 * (2.0 + small + math.sqrt(small**2 + 4.0))
        slow = math.sqrt(small) if z == 0 else min(math.sqrt(small), small / (4.0 * z))
        return Constants(
            gamma=1.0,
            L_F=1.0,
            alpha_h=math.sqrt(2.0) / w,
            beta_h=0.0,
            alpha_f=0.0,
            beta_f=w / tau,
            M=1.0,
            omega=0.5 * np.linalg.eigvalsh(scaled + scaled.T)[-1],
            m_P=1.0,
            norm_P_inv=1.0,
            energy=(largest_V / math.sqrt(small), 0.5 * w * slow),
            status="proved",
        )

    def solve(self, **settings: Any) -> Solution:
        """The whole record from rest, saved at its times and seven between two of them; by
        `dvax.PiecewiseLinear`, at a cost that does not depend on η/k; where values are traced
        (`jax.jit`, `jax.grad`), or `dt` is given, by `dvax.ExpRosenbrock`. `settings` go to
        `dvax.solve`."""
        settings = {"ts": self.times, "rtol": 1e-8} | settings
        if settings.get("method") is None:
            traced = not _tree.is_concrete(self, *settings.values())
            follow = traced or settings.get("dt") is not None
            settings["method"] = ExpRosenbrock() if follow else PiecewiseLinear()
        end = self.record.duration
        return solve(self.problem, jnp.zeros(3), 0.0, end, **settings)

    @property
    def times(self) -> np.ndarray:
        """When `solve` saves; every eighth of them is a time of the record."""
        count = self.record.samples.shape[0]
        times = self.record.step / _BETWEEN * np.arange((count - 1) * _BETWEEN + 1)
        times[::_BETWEEN] = self.record.knots()
        return times

    def largest_displacement(self, solution: Solution) -> jax.Array:
        """max |d| of a `solve`, between saved times as well (in)."""
        d, v, _ = solution.xs.T
        a = jax.vmap(self.acceleration)(solution.ts, solution.xs)
        return largest(d, v, a, self.record.step / _BETWEEN)

    def elastoplastic_distance(self, solution: Solution) -> jax.Array:
        """A bound on |d − d⁰| at the saved times of a `solve`, in in: d⁰ is the displacement of the
        elastoplastic frame, the limit as τ = η/k → 0, of the same yield displacement.

        The elongation beyond yield is o ≤ δ = τ max |d'|. p = d_p is what the elastoplastic law makes
        of d − o, and the play operator has the constant 1, so that the elastoplastic law makes of d
        itself what differs from p by δ at most. In the equation of d⁰ this is a force of ω²δ a mass,
        and

            |d − d⁰| ≤ ½ω²δt²,    |d' − d⁰'| ≤ ω²δt,

        since the energy of a difference never grows by itself. Between saved times |d'| is bounded by
        what accelerates it. It is proportional to τ, and far from sharp. Source: Brokate and Sprekels,
        *Hysteresis and Phase Transitions* (1996), Proposition 2.3.4.
        """
        w, tau, limit = self.omega, self.viscosity_ratio, self.yield_displacement
        ts = solution.ts
        half = 0.5 * jnp.max(jnp.diff(ts, prepend=0.0))
        ground = jnp.max(jnp.abs(self.record.samples))
        speed = jax.lax.cummax(jnp.abs(solution.xs[:, 1]))
        left = 1.0 - half * (2.0 * self.damping * w + w**2 * tau)
        most = (speed + half * (w**2 * limit + ground)) / left
        bound = 0.5 * w**2 * tau * jnp.where(left > 0.0, most, jnp.inf) * ts**2
        return jnp.where(jnp.isinf(limit), 0.0, bound)

    def acceleration(self, t: Any, x: jax.Array) -> jax.Array:
        """d'' (in/s²)."""
        w = self.omega
        return -2.0 * self.damping * w * x[1] - w**2 * (x[0] - x[2]) - self.record.value(t)

    def figures(self, **settings: Any) -> dict[str, float]:
        """`peak_displacement`: max |d| at the times of the record, which is what tables of the field
        have; `largest_displacement`: at all times; `yield_displacement`: d_y. All in in."""
        solution = self.solve(**settings)
        return {
            "peak_displacement": float(jnp.max(jnp.abs(solution.xs[::_BETWEEN, 0]))),
            "largest_displacement": float(self.largest_displacement(solution)),
            "yield_displacement": float(self.yield_displacement),
        }


class _Rate(eqx.Module):
    """f = (0, −a_g(t), −u/τ)."""

    record: Accelerogram
    rate: jax.Array

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        ground = self.record(t)
        return jnp.stack([jnp.zeros_like(ground), -ground, -self.rate * u[0]])


class _Elastic(eqx.Module):
    """h = d − d_p."""

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return x[:1] - x[2:]


def _fits(name: str, value: float) -> bool:
    return math.isfinite(value) and (value >= 0 if name == "damping" else value > 0)


def _checked(record: Any, given: dict[str, Any]) -> dict[str, jax.Array]:
    """The numbers that were given, as arrays."""
    values: dict[str, jax.Array] = {}
    wrong = Problems()

    def say(name: str, given: str, rule: str, fix: str) -> None:
        wrong.add(f"dvax.models.Frame({name})", given, rule, fix)

    if not isinstance(record, Accelerogram):
        say("record", type(record).__name__, "it is a dvax.models.Accelerogram",
            "Make one from the step and the samples")  # fmt: skip
    for name, value in given.items():
        if value is None:
            continue
        try:
            number = _tree.as_float(value, f"dvax.models.Frame({name})")
        except InputError as error:
            wrong += error.problems
            continue
        values[name] = number
        rule = "a number ≥ 0" if name == "damping" else "a positive number"
        if jnp.ndim(number) != 0:
            say(name, f"shape {jnp.shape(number)}", f"it is {rule}",
                "Use dvax.models.response_spectrum for many frames")  # fmt: skip
        elif _tree.is_concrete(number) and not _fits(name, float(number)):
            say(name, f"{float(number):g}", f"it is {rule}", "Fix it")
    yields = [name for name in ("yield_ratio", "yield_displacement") if given[name] is not None]
    if len(yields) == 2:
        say(
            "yield_ratio, yield_displacement", "both", "they say the same thing", "Give one of them"
        )
    if yields and given["viscosity_ratio"] is None:
        say("viscosity_ratio", "None", "how fast a frame that yields flows has no default",
            "Give η/k in s, a hundredth of the period, say: viscosity_ratio = 0.01")  # fmt: skip
    if not yields and given["viscosity_ratio"] is not None:
        flow = given["viscosity_ratio"]
        say("viscosity_ratio", _tree.short(flow) if _tree.is_concrete(flow) else "a traced value",
            "a frame without a yield force stays elastic and does not flow",
            "Leave it out, or say when the frame yields: yield_ratio = 0.5")  # fmt: skip
    wrong.raise_any()
    return values
