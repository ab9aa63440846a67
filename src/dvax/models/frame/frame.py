"""A one-storey elastoplastic frame under ground acceleration."""

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
from .peaks import peak_displacement

_SAVES_PER_SAMPLE = 8
"""Number of saved times in an interval of the record."""


class Frame(eqx.Module):
    """An oscillator with a Duvaut–Lions viscoplastic spring under ground acceleration.

        d'' = −2ζω d' − ω²(d − d_p) − a_g(t),            ω = 2π/T
        d_p' = ((d − d_p) − u)/τ,    u = proj_K(d − d_p),    K = [−d_y, d_y],    τ = η/k

    d is the displacement relative to the ground and d_p its plastic part (in). k(d − d_p) is the force
    of the spring, and k u its part within the yield force f_y = k d_y; the excess drives the plastic
    flow. The state is x = (d, d', d_p) with ‖x‖² = (ωd)² + d'² + (ωd_p)². A contains the linear terms:

        A = [[0, 1, 0], [−ω², −2ζω, ω²], [1/τ, 0, −1/τ]],  f = (0, −a_g(t), −u/τ),  h = d − d_p,  P = 1.

    **Arguments:** `record`: an `Accelerogram`; `period` T in s; `damping` ζ, the damping ratio;
    `yield_ratio` = f_y / (largest elastic force), or `yield_displacement` d_y in in, or neither for an
    elastic frame; `viscosity_ratio` τ = η/k in s, for a frame that yields.

    **Exactness.** The viscoplastic frame is in the class of the theory, with γ = L_F = 1. It is a
    regularisation of the elastoplastic frame with an error O(η/k) of the displacement, which
    `elastoplastic_distance` bounds. The cost does not increase as η/k → 0.

    **Raises:** `dvax.InputError` with all invalid arguments.

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
        # An elastic frame has no plastic flow, so its viscosity is arbitrary.
        viscosity_ratio = values.get("viscosity_ratio")
        if viscosity_ratio is None:
            viscosity_ratio = jnp.ones_like(self.period)
        self.viscosity_ratio = viscosity_ratio
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
        """How the model relates to the class of the theory."""
        if _tree.is_concrete(self.yield_displacement) and np.all(np.isinf(self.yield_displacement)):
            return "exact"
        return (
            f"regularised by η/k = {_tree.short(self.viscosity_ratio)} s: an elastoplastic frame in "
            "the limit 0; exact as a viscoplastic frame"
        )

    @property
    def problem(self) -> Problem:
        """The coupled problem."""
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
            h=_ElasticPart(),
            state_space=L2(jnp.stack([w**2, one, w**2])),
            control_space=Euclidean(1),
        )

    @property
    def constants(self) -> Constants:
        """The proved constants.

        γ = L_F = 1, α_h = √2/ω, β_h = 0, α_f = 0, β_f = ω/τ, M = 1 and ω_A from A. The difference of
        two trajectories satisfies, since the projection is monotone,

            V = ½(ω(d − d_p))² + ½d'² + ½ε(ωd)²,   V' ≤ −2ζω d'² + εω² d d' ≤ 2μV

        with μ = ½ω min(√ε, ε/4ζ). So `energy` = (M, μ), where M² is the condition number of V in the
        norm of x, and √ε = 2/(ω · duration)."""
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
        """Solve over the whole record from the state 0, and save at `times`.

        The method is `dvax.PiecewiseLinear`, whose cost does not depend on η/k. With traced values
        (`jax.jit`, `jax.grad`) or a given `dt` it is `dvax.ExpRosenbrock`. `settings` are passed to
        `dvax.solve`."""
        settings = {"ts": self.times, "rtol": 1e-8} | settings
        if settings.get("method") is None:
            traced = not _tree.is_concrete(self, *settings.values())
            use_steps = traced or settings.get("dt") is not None
            settings["method"] = ExpRosenbrock() if use_steps else PiecewiseLinear()
        end = self.record.duration
        return solve(self.problem, jnp.zeros(3), 0.0, end, **settings)

    @property
    def times(self) -> np.ndarray:
        """The saved times of `solve`; every eighth is a time of the record."""
        count = self.record.samples.shape[0]
        times = (
            self.record.step / _SAVES_PER_SAMPLE * np.arange((count - 1) * _SAVES_PER_SAMPLE + 1)
        )
        times[::_SAVES_PER_SAMPLE] = self.record.knots()
        return times

    def largest_displacement(self, solution: Solution) -> jax.Array:
        """Return max |d| of a solution, between saved times as well (in)."""
        d, v, _ = solution.xs.T
        a = jax.vmap(self.acceleration)(solution.ts, solution.xs)
        return peak_displacement(d, v, a, self.record.step / _SAVES_PER_SAMPLE)

    def elastoplastic_distance(self, solution: Solution) -> jax.Array:
        """Return a bound on |d − d⁰| at the saved times of a solution, in in.

        d⁰ is the displacement of the elastoplastic frame with the same yield displacement, which is
        the limit τ = η/k → 0. The elongation beyond yield is o ≤ δ = τ max |d'|. p = d_p is the
        response of the elastoplastic law to d − o. The play operator has the Lipschitz constant 1, so
        the response to d differs from p by at most δ. In the equation of d⁰ this is a force of ω²δ a
        unit mass, and

            |d − d⁰| ≤ ½ω²δt²,    |d' − d⁰'| ≤ ω²δt,

        since the energy of a difference does not increase without a force. Between saved times |d'| is
        bounded by means of the acceleration. The bound is proportional to τ, and not sharp. Source:
        Brokate and Sprekels, *Hysteresis and Phase Transitions* (1996), Proposition 2.3.4.
        """
        return self.distance_bound(solution.ts, solution.xs[:, 1])

    def distance_bound(self, ts: Any, velocity: Any) -> jax.Array:
        """Return the bound of `elastoplastic_distance` from the velocities at the times ts."""
        w, tau, limit = self.omega, self.viscosity_ratio, self.yield_displacement
        ts = jnp.asarray(ts)
        half = 0.5 * jnp.max(jnp.diff(ts, prepend=0.0))
        ground = jnp.max(jnp.abs(self.record.samples))
        speed = jax.lax.cummax(jnp.abs(jnp.asarray(velocity)))
        denominator = 1.0 - half * (2.0 * self.damping * w + w**2 * tau)
        max_speed = (speed + half * (w**2 * limit + ground)) / denominator
        max_speed = jnp.where(denominator > 0.0, max_speed, jnp.inf)
        bound = 0.5 * w**2 * tau * max_speed * ts**2
        return jnp.where(jnp.isinf(limit), 0.0, bound)

    def acceleration(self, t: Any, x: jax.Array) -> jax.Array:
        """Return d'' (in/s²)."""
        w = self.omega
        return -2.0 * self.damping * w * x[1] - w**2 * (x[0] - x[2]) - self.record.value(t)

    def figures(self, **settings: Any) -> dict[str, float]:
        """Return the results, in in.

        `peak_displacement`: max |d| at the times of the record, as usually tabulated;
        `largest_displacement`: max |d| at all times; `yield_displacement`: d_y."""
        solution = self.solve(**settings)
        return {
            "peak_displacement": float(jnp.max(jnp.abs(solution.xs[::_SAVES_PER_SAMPLE, 0]))),
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


class _ElasticPart(eqx.Module):
    """h = d − d_p."""

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return x[:1] - x[2:]


def _is_valid(name: str, value: float) -> bool:
    return math.isfinite(value) and (value >= 0 if name == "damping" else value > 0)


def _checked(record: Any, given: dict[str, Any]) -> dict[str, jax.Array]:
    """Return the given numbers as arrays; raise an `InputError` with all problems."""
    values: dict[str, jax.Array] = {}
    wrong = Problems()

    def add(name: str, given: str, rule: str, fix: str) -> None:
        wrong.add(f"dvax.models.Frame({name})", given, rule, fix)

    if not isinstance(record, Accelerogram):
        add("record", type(record).__name__, "it must be a dvax.models.Accelerogram",
            "Create one from the step and the samples")  # fmt: skip
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
            add(name, f"shape {jnp.shape(number)}", f"it must be {rule}",
                "Use dvax.models.response_spectrum for many frames")  # fmt: skip
        elif _tree.is_concrete(number) and not _is_valid(name, float(number)):
            add(name, f"{float(number):g}", f"it must be {rule}", "Correct the value")
    yields = [name for name in ("yield_ratio", "yield_displacement") if given[name] is not None]
    if len(yields) == 2:
        add(
            "yield_ratio, yield_displacement", "both", "each determines the other",
            "Give one of them",
        )  # fmt: skip
    if yields and given["viscosity_ratio"] is None:
        add("viscosity_ratio", "None", "a frame that yields needs it",
            "Give η/k in s, such as a hundredth of the period: viscosity_ratio = 0.01")  # fmt: skip
    if not yields and given["viscosity_ratio"] is not None:
        ratio = given["viscosity_ratio"]
        add("viscosity_ratio", _tree.short(ratio) if _tree.is_concrete(ratio) else "a traced value",
            "a frame without a yield force is elastic and has no plastic flow",
            "Omit it, or give a yield force: yield_ratio = 0.5")  # fmt: skip
    wrong.raise_any()
    return values
