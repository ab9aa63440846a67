"""A Kelvin–Voigt body under a rigid punch, with normal compliance and a pressure cap."""

import math
import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ... import _tree
from ...errors import InputError, Problems, input_error
from ...evolution import ETD2RK, ExpRosenbrock, Implicit
from ...generators import Scalar
from ...operators import Scaling
from ...problem import Problem
from ...sets import Box
from ...signals import AbstractSignal, Function
from ...spaces import L2, Euclidean
from ...theory import Constants
from ...vi import AbstractSolver
from ..contact import ACTIVE, SATURATED, UNLOADED
from .body import ElasticBody
from .equilibrium import Equilibrium, Law, solve_equilibrium
from .fields import write

RAMP = 2.0
"""Default duration of the indentation ramp."""

_MAX_EXPLICIT_RATE = 2000.0
"""Up to this rate, in 1/τ, many short explicit steps cost less than few with a matrix exponential."""

_MAX_DENSE_STATES = 256
"""Largest number of states for `ExpRosenbrock`, which forms a dense matrix."""


class FemContact(eqx.Module):
    """A Kelvin–Voigt body under a rigid parabolic punch, quasistatic.

        𝒜x' + ℬx = −γ_ν* p in V',    𝒜 = τℬ,    p = βu on Γ_C
        u ∈ γ_ν x − g(t) − b_u u − N_K(βu),    K = {0 ≤ p ≤ κ₀},    U = L²(Γ_C)

    x is the displacement, V its space with the inner product of the viscosity 𝒜; γ_ν x the outward
    normal displacement on Γ_C; g(t) = (s²/2R + y₀ − y) ν_y − δ(t) ν_y the gap to the punch, linear
    in the slope, with s the horizontal distance from its axis; δ its depth below the highest node y₀
    of Γ_C; p the pressure, proportional to the penetration γ_ν x − g up to the cap κ₀. In V

        A = −𝒜⁻¹ℬ = −I/τ,    P = βI,    f = −𝒜⁻¹γ_ν* P u,    h = γ_ν x − g(t) − b_u u.

    **The state.** The law couples only to the component of x in V₁ = (ker γ_ν)^⊥, which is invariant
    under A. The component in ker γ_ν decays independently as e^{−t/τ}. The state x of the model holds
    the coordinates in an orthonormal basis of V₁ (`ElasticBody.trace`). This is no approximation; norms
    are those of V, and `displacement(x)` returns the full field. In these coordinates f and h are
    −Tᵀ W P u/√τ and Tx/√τ − g − b_u u.

    **Arguments:**

    - `body`: an `ElasticBody` with the mesh and the elastic moduli;
    - `indentation`: the final depth δ of a linear ramp of the duration `ramp` (default 2), or the
      history δ(t): one of `dvax.signals`, or a callable of t;
    - `stiffness`: β > 0, in [p]/[x]; `pressure_cap`: κ₀ > 0 in [p], ∞ for none;
    - `radius`: R > 0 of the punch, ∞ for a flat one; `centre`: the position of its axis, by default
      the middle of Γ_C; `relaxation_time`: τ > 0; `b_u` ≥ 0: feedback of the response on itself.

    **Raises:** `dvax.InputError` with all invalid parameters.

    Lengths are in one unit [x], pressures and moduli in one [p], times in one [t]; a force is in
    [p][x], for a slice of unit thickness. The constants are proved (docs/models/fem-contact.md). The
    growth rate ω + ML̃ of the paper is positive and large, βc₁/τ − 1/τ, but the flow contracts with
    the rate 1/τ.

    ```python
    >>> import jax, dvax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from dvax.models.fem_contact import ElasticBody, FemContact
    >>> body = ElasticBody({"fine": 10, "coarse": 4, "layers": 17})
    >>> model = FemContact(body, indentation=0.01, stiffness=100.0, pressure_cap=0.01)
    >>> rest = model.equilibrium()
    >>> print(f"{model.figures(rest.pressure)['force']:.8e}")
    4.67498819e-03
    >>> float(model.constants.one_sided), float(model.constants.decay_rate) < -300
    (-1.0, True)

    ```
    """

    body: ElasticBody = eqx.field(static=True)
    trace: jax.Array
    weights: jax.Array
    vertical_normal: jax.Array
    gap: jax.Array
    depth: AbstractSignal
    final_depth: jax.Array | None
    beta: jax.Array
    kappa0: jax.Array
    tau: jax.Array
    b_u: jax.Array

    def __init__(
        self,
        body: ElasticBody,
        *,
        indentation: Any,
        stiffness: Any,
        pressure_cap: Any,
        radius: Any = 10.0,
        relaxation_time: Any = 1.0,
        b_u: Any = 0.0,
        ramp: Any = None,
        centre: Any = None,
    ):
        numbers = {
            "stiffness": stiffness, "pressure_cap": pressure_cap, "radius": radius,
            "relaxation_time": relaxation_time, "b_u": b_u,
        }  # fmt: skip
        if centre is None:
            centre = 0.5 * float(body.points[:, 0].min() + body.points[:, 0].max())
        numbers["centre"] = centre
        values: dict[str, jax.Array] = {}
        wrong = Problems()
        for name, value in numbers.items():
            with wrong.collect():
                values[name] = _number(name, value)
        with wrong.collect():
            self.depth, self.final_depth = _history(indentation, ramp)
        wrong.raise_any()
        self.body = body
        self.trace, self.weights = jnp.asarray(body.trace), jnp.asarray(body.weights)
        self.vertical_normal = jnp.asarray(body.normals[:, 1])
        s, y = jnp.asarray(body.points[:, 0]) - values["centre"], jnp.asarray(body.points[:, 1])
        self.gap = self.vertical_normal * (s**2 / (2.0 * values["radius"]) + (body.top - y))
        self.beta, self.kappa0 = values["stiffness"], values["pressure_cap"]
        self.tau, self.b_u = values["relaxation_time"], values["b_u"]

    @property
    def problem(self) -> Problem:
        """The problem with A = −I/τ, P = βI, K = [0, κ₀], a Euclidean state space, U = L²(Γ_C)."""
        return Problem(
            A=Scalar(-1.0 / _tree.host(self.tau)),
            P=Scaling(self.beta),
            K=Box(0.0, self.kappa0),
            f=_PressureRate(self.trace, self.weights, self.beta, self.tau),
            h=_Penetration(
                self.trace, self.gap, self.vertical_normal, self.depth, self.tau, self.b_u
            ),
            state_space=Euclidean(self.trace.shape[1]),
            control_space=L2(self.weights),
        )

    @property
    def constants(self) -> Constants:
        """The proved constants.

        γ = L_F = (1+b_u)/β, α_h = ‖γ_ν‖ = √(c₁/τ) with c₁ = ‖C‖, β_h = b_u, α_f = 0, β_f = β‖γ_ν‖,
        M = 1, ω = −1/τ, m_P = ‖P⁻¹‖ = 1/β. The one-sided rate is μ = −1/τ, since the contact term
        −⟨Δp, γ_νΔx⟩ ≤ −(1+b_u)/β ‖Δp‖² is never positive."""
        beta, tau, b_u = _tree.host((self.beta, self.tau, self.b_u))
        norm = (self.body.compliance[0] / tau) ** 0.5
        return Constants(
            gamma=(1.0 + b_u) / beta,
            L_F=(1.0 + b_u) / beta,
            alpha_h=norm,
            beta_h=b_u,
            alpha_f=0.0,
            beta_f=beta * norm,
            M=1.0,
            omega=-1.0 / tau,
            m_P=1.0 / beta,
            norm_P_inv=1.0 / beta,
            one_sided=-1.0 / tau,
            status="proved",
        )

    @property
    def steady_constants(self) -> tuple[Any, Any]:
        """(γ, L_F) of the static law F(p) = (1+b_u)p/β + Cp + g.

        They are ((1+b_u)/β, (1+b_u)/β + c₁), since 0 ≤ C ≤ c₁."""
        beta, b_u = _tree.host((self.beta, self.b_u))
        gamma = (1.0 + b_u) / beta
        return gamma, gamma + self.body.compliance[0]

    @property
    def fit(self) -> str:
        """How the model relates to the class of the theory."""
        return "exact"

    @property
    def untouched(self) -> jax.Array:
        """The state without displacement, zeros."""
        return jnp.zeros_like(self.trace[0])

    @property
    def method(self) -> ETD2RK | ExpRosenbrock | Implicit:
        """The recommended method, which depends on the fastest rate (1 + βc₁/(1+b_u))/τ.

        Up to 2000/τ it is `ETD2RK`, with steps of the order of the inverse rate that cost two products
        with T, and with a proved error bound. Beyond, it is `ExpRosenbrock`, which is exact between
        kinks, for up to 256 states, and `Implicit` for more."""
        beta, b_u = float(self.beta), float(self.b_u)
        if 1.0 + beta * self.body.compliance[0] / (1.0 + b_u) <= _MAX_EXPLICIT_RATE:
            return ETD2RK()
        return ExpRosenbrock() if self.trace.shape[1] <= _MAX_DENSE_STATES else Implicit()

    def penetration(self, t: Any, x: Any) -> jax.Array:
        """Return γ_ν x − g(t) at the points of Γ_C, positive where the bodies overlap."""
        normal_displacement = (self.trace @ x) / jnp.sqrt(self.tau)
        return normal_displacement - self.gap + self.vertical_normal * self.depth(t)

    def pressure(self, t: Any, x: Any) -> jax.Array:
        """Return p = proj_{[0,κ₀]}(β(γ_ν x − g(t))/(1+b_u))."""
        return jnp.clip(self._drive(t, x), 0.0, self.kappa0)

    def regimes(self, t: Any, x: Any) -> jax.Array:
        """Return 0 where separated, 1 where in contact, 2 where at the cap."""
        drive = self._drive(t, x)
        regime = jnp.where(
            drive <= 0.0, UNLOADED, jnp.where(drive >= self.kappa0, SATURATED, ACTIVE)
        )
        return regime.astype(jnp.int8)

    def equilibrium(
        self, indentation: Any = None, *, solver: AbstractSolver | None = None, tol: Any = 1e-9
    ) -> Equilibrium:
        """Return the static equilibrium at the depth `indentation`, by default the final one.

        There γ_ν x = −Cp, so p solves VI(K, F) with F(p) = (1+b_u)p/β + Cp + g. `tol` bounds the error
        of p in L²(Γ_C), relative to the largest pressure that the punch could cause,
        min(κ₀, βδ/(1+b_u)). `solver`: `dvax.vi.ActiveSet` by default.

        **Raises:** `dvax.InputError` if the model has a history and no depth is given.
        """
        given = self.final_depth if indentation is None else indentation
        if given is None:
            raise _error(
                "indentation", "a history, and no depth for the equilibrium",
                "a history has no final depth", "Call equilibrium(depth) with a constant depth",
            )  # fmt: skip
        depth = _tree.as_float(given, "indentation")
        law = Law(
            self.trace, self.weights, self.gap - self.vertical_normal * depth,
            self.beta / (1.0 + self.b_u), self.kappa0,
        )  # fmt: skip
        vi = solve_equilibrium(law, float(self.body.compliance[0]), solver, tol)
        x = -jnp.sqrt(self.tau) * ((self.weights * vi.y) @ self.trace)
        return Equilibrium(vi.y, x, vi)

    def figures(self, pressure: Any) -> dict[str, float]:
        """Return the results for a pressure on Γ_C.

        `force`: the resultant on the punch, in [p][x]; `contact_half_width`: half of the distance
        between the outermost points in contact; `saturated_length`: the measure of the points at κ₀,
        in [x]; `peak_pressure`, in [p]."""
        p, w, s = np.asarray(pressure), self.body.weights, self.body.points[:, 0]
        in_contact = s[p > 0]
        return {
            "force": float(np.sum(w * self.body.normals[:, 1] * p)),
            "contact_half_width": 0.5 * float(np.ptp(in_contact)) if in_contact.size else 0.0,
            "saturated_length": float(np.sum(w[p >= float(self.kappa0)])),
            "peak_pressure": float(p.max()),
        }

    def displacement(self, x: Any) -> np.ndarray:
        """Return the displacement of every node of the body, (n, 2), for a state x.

        Its component in ker γ_ν is omitted; it is zero for a body that is initially undeformed."""
        return self.body.displacement(np.asarray(x) / math.sqrt(float(self.tau)))

    def stress(self, t: Any, x: Any) -> np.ndarray:
        """Return the element means σ_xx, σ_yy, σ_zz, σ_xy of the stress ℬε(x) + 𝒜ε(x').

        With 𝒜 = τℬ it equals the elastic stress of a static body under the pressure p(t)."""
        return self.body.stress(self.body.displacement_under(self.pressure(t, x)))

    def write(self, path: str | os.PathLike[str], t: Any, x: Any) -> tuple[Path, Path]:
        """Write the fields at time t to two files, .vtu or .vtk, and return their paths.

        The first has the body with its displacement and stress. The second, NAME-contact, has the
        points of Γ_C with pressure, penetration and regime."""
        contact = {
            "pressure": np.asarray(self.pressure(t, x)),
            "penetration": np.asarray(self.penetration(t, x)),
            "regime": np.asarray(self.regimes(t, x), np.int32),
        }
        return write(self.body, Path(path), self.displacement(x), self.stress(t, x), contact)

    def _drive(self, t: Any, x: Any) -> jax.Array:
        return self.beta / (1.0 + self.b_u) * self.penetration(t, x)


class _PressureRate(eqx.Module):
    """f = −𝒜⁻¹γ_ν* P u, in coordinates."""

    trace: jax.Array
    weights: jax.Array
    beta: jax.Array
    tau: jax.Array

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return (self.weights * (-self.beta / jnp.sqrt(self.tau) * u)) @ self.trace


class _Penetration(eqx.Module):
    """h = γ_ν x − g(t) − b_u u."""

    trace: jax.Array
    gap: jax.Array
    vertical_normal: jax.Array
    depth: AbstractSignal
    tau: jax.Array
    b_u: jax.Array

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        normal_displacement = (self.trace @ x) / jnp.sqrt(self.tau)
        penetration = normal_displacement - self.gap + self.vertical_normal * self.depth(t)
        return penetration - self.b_u * u


class _Ramp(eqx.Module):
    """δ(t), a linear ramp followed by a constant."""

    depth: jax.Array
    time: float = eqx.field(static=True)

    def __call__(self, t: Any) -> jax.Array:
        return self.depth * jnp.minimum(t / self.time, 1.0)


def _history(value: Any, ramp: Any) -> tuple[AbstractSignal, jax.Array | None]:
    """Return δ(t), and its final value for a ramp."""
    if isinstance(value, AbstractSignal) or callable(value):
        if ramp is not None:
            raise _error("ramp", repr(ramp), "a history of indentation has no ramp",
                         "Omit it")  # fmt: skip
        return value if isinstance(value, AbstractSignal) else Function(value), None
    depth = _number("indentation", value)
    time = RAMP if ramp is None else ramp
    if isinstance(time, bool) or not isinstance(time, int | float) or not 0 < time < math.inf:
        raise _error("ramp", repr(time), "it must be a positive number, a duration",
                     "Give a small one for a sudden indentation")  # fmt: skip
    return Function(_Ramp(depth, float(time)), knots=[float(time)]), depth


_RULES: dict[str, tuple[Any, str]] = {
    "stiffness": (lambda v: 0 < v < math.inf, "it must be a positive number: the law is strongly "
                  "monotone with 1/β"),
    "pressure_cap": (lambda v: v > 0, "it must be positive (∞ for no cap)"),
    "radius": (lambda v: v > 0, "it must be positive (∞ for a flat punch)"),
    "relaxation_time": (lambda v: 0 < v < math.inf, "it must be a positive number, viscosity over "
                        "elasticity"),
    "b_u": (lambda v: 0 <= v < math.inf, "it must be a number ≥ 0"),
    "centre": (math.isfinite, "it must be a finite number"),
    "indentation": (math.isfinite, "it must be a finite number or a history in time"),
}  # fmt: skip


def _number(name: str, value: Any) -> jax.Array:
    number = _tree.as_float(value, f"dvax.models.FemContact({name})")
    holds, rule = _RULES[name]
    if jnp.ndim(number) != 0:
        raise _error(name, f"an array of shape {jnp.shape(number)}", rule, "Give one number")
    if _tree.is_concrete(number) and not holds(float(number)):
        raise _error(name, f"{float(number):g}", rule, "Correct the value, or its unit")
    return number


def _error(name: str, given: str, rule: str, fix: str) -> InputError:
    return input_error(f"dvax.models.FemContact({name})", given, rule, fix)
