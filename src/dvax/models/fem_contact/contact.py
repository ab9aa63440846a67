"""The Kelvin–Voigt body under a rigid punch, with a normal compliance of finite pressure."""

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
from .fields import write
from .rest import Equilibrium, Law, at_rest

RAMP = 2.0
"""Time over which a punch is pressed in where only the depth is given."""

_STIFF = 2000.0
"""Up to this rate, in 1/τ, many short steps cost less than few that form a matrix exponential."""

_EXPONENTIAL = 256
"""Up to so many states `ExpRosenbrock` forms a matrix."""


class FemContact(eqx.Module):
    """A block of Kelvin–Voigt material under a rigid parabolic punch, quasistatic.

        𝒜x' + ℬx = −γ_ν* p in V',    𝒜 = τℬ,    p = βu on Γ_C
        u ∈ γ_ν x − g(t) − b_u u − N_K(βu),    K = {0 ≤ p ≤ κ₀},    U = L²(Γ_C)

    x is the displacement, V its space with the inner product of the viscosity 𝒜; γ_ν x the outward
    normal displacement on Γ_C; g(t) = (s²/2R + y₀ − y) ν_y − δ(t) ν_y the gap to the punch, linear
    in the slope, with s the horizontal distance from its axis; δ its depth below the highest node y₀
    of Γ_C; p the pressure, proportional to the penetration γ_ν x − g up to the cap κ₀. In V

        A = −𝒜⁻¹ℬ = −I/τ,    P = βI,    f = −𝒜⁻¹γ_ν* P u,    h = γ_ν x − g(t) − b_u u.

    **The state.** The law sees and moves x in V₁ = (ker γ_ν)^⊥ alone, which A leaves invariant; in
    ker γ_ν every displacement decays as e^{−t/τ} by itself. So x stands here for its coordinates in
    an orthonormal basis of V₁ (`ElasticBody.trace`): nothing is approximated, norms are those of V,
    and the bulk is `displacement(x)`. f and h are then −Tᵀ W P u/√τ and Tx/√τ − g − b_u u.

    **Arguments:**

    - `body`: an `ElasticBody`, which carries the mesh and the elastic moduli;
    - `indentation`: the depth δ that is reached on a ramp over `ramp` (2 units of time by default), or
      the history δ(t): one of `dvax.signals`, or a callable of t;
    - `stiffness`: β > 0, in [p]/[x]; `pressure_cap`: κ₀ > 0 in [p], ∞ for none;
    - `radius`: R > 0 of the punch, ∞ for a flat one; `centre`: where its axis is, the middle of Γ_C
      by default; `relaxation_time`: τ > 0; `b_u` ≥ 0: feedback of the response on itself.

    **Raises:** `dvax.InputError` for every parameter that breaks its rule.

    Lengths are in one unit [x], pressures and moduli in one [p], times in one [t]; a force is in
    [p][x], for a slice of unit thickness. The constants are proved (docs/models/fem-contact.md): the
    paper's rate ω + ML̃ is positive by far, βc₁/τ − 1/τ, and the flow contracts with 1/τ all the same.

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
    lean: jax.Array
    gap: jax.Array
    depth: AbstractSignal
    final: jax.Array | None
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
        found: dict[str, jax.Array] = {}
        wrong = Problems()
        for name, value in numbers.items():
            with wrong.collect():
                found[name] = _number(name, value)
        with wrong.collect():
            self.depth, self.final = _history(indentation, ramp)
        wrong.raise_any()
        self.body = body
        self.trace, self.weights = jnp.asarray(body.trace), jnp.asarray(body.weights)
        self.lean = jnp.asarray(body.normals[:, 1])
        s, y = jnp.asarray(body.points[:, 0]) - found["centre"], jnp.asarray(body.points[:, 1])
        self.gap = self.lean * (s**2 / (2.0 * found["radius"]) + (body.top - y))
        self.beta, self.kappa0 = found["stiffness"], found["pressure_cap"]
        self.tau, self.b_u = found["relaxation_time"], found["b_u"]

    @property
    def problem(self) -> Problem:
        """The coupled system: A = −I/τ, P = βI, K = [0, κ₀], states Euclidean, U = L²(Γ_C)."""
        return Problem(
            A=Scalar(-1.0 / _tree.host(self.tau)),
            P=Scaling(self.beta),
            K=Box(0.0, self.kappa0),
            f=_Push(self.trace, self.weights, self.beta, self.tau),
            h=_Penetration(self.trace, self.gap, self.lean, self.depth, self.tau, self.b_u),
            state_space=Euclidean(self.trace.shape[1]),
            control_space=L2(self.weights),
        )

    @property
    def constants(self) -> Constants:
        """γ = L_F = (1+b_u)/β, α_h = ‖γ_ν‖ = √(c₁/τ) with c₁ = ‖C‖, β_h = b_u, α_f = 0,
        β_f = β‖γ_ν‖, M = 1, ω = −1/τ, m_P = ‖P⁻¹‖ = 1/β, and the one-sided rate μ = −1/τ: what the
        contact adds, −⟨Δp, γ_νΔx⟩ ≤ −(1+b_u)/β ‖Δp‖², has one sign."""
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
        """(γ, L_F) of the law at rest, F(p) = (1+b_u)p/β + Cp + g: ((1+b_u)/β, (1+b_u)/β + c₁), since
        0 ≤ C ≤ c₁."""
        beta, b_u = _tree.host((self.beta, self.b_u))
        gamma = (1.0 + b_u) / beta
        return gamma, gamma + self.body.compliance[0]

    @property
    def fit(self) -> str:
        """How the model lies in the class."""
        return "exact"

    @property
    def untouched(self) -> jax.Array:
        """The state of a body that nothing has touched."""
        return jnp.zeros_like(self.trace[0])

    @property
    def method(self) -> ETD2RK | ExpRosenbrock | Implicit:
        """What to solve with. The law makes a rate 1 + βc₁/(1+b_u) of 1/τ. Up to 2000: `ETD2RK`, whose
        steps are as short as that and cost two products with T, and whose error bound is proved.
        Beyond: `ExpRosenbrock`, exact between kinks, up to 256 states; then `Implicit`."""
        beta, b_u = float(self.beta), float(self.b_u)
        if 1.0 + beta * self.body.compliance[0] / (1.0 + b_u) <= _STIFF:
            return ETD2RK()
        return ExpRosenbrock() if self.trace.shape[1] <= _EXPONENTIAL else Implicit()

    def penetration(self, t: Any, x: Any) -> jax.Array:
        """γ_ν x − g(t), positive where the bodies overlap, at the points of Γ_C."""
        return (self.trace @ x) / jnp.sqrt(self.tau) - self.gap + self.lean * self.depth(t)

    def pressure(self, t: Any, x: Any) -> jax.Array:
        """p = proj_{[0,κ₀]}(β(γ_ν x − g(t))/(1+b_u))."""
        return jnp.clip(self._drive(t, x), 0.0, self.kappa0)

    def regimes(self, t: Any, x: Any) -> jax.Array:
        """0 apart, 1 in contact, 2 at the cap."""
        drive = self._drive(t, x)
        regime = jnp.where(
            drive <= 0.0, UNLOADED, jnp.where(drive >= self.kappa0, SATURATED, ACTIVE)
        )
        return regime.astype(jnp.int8)

    def equilibrium(
        self, indentation: Any = None, *, solver: AbstractSolver | None = None, tol: Any = 1e-9
    ) -> Equilibrium:
        """The state at rest under a punch held at the depth `indentation`, by default the end of the
        ramp. There γ_ν x = −Cp, so p solves VI(K, F) with F(p) = (1+b_u)p/β + Cp + g; `tol` is on
        its true error in L²(Γ_C), relative to the largest pressure that the punch could cause,
        min(κ₀, βδ/(1+b_u)). `solver`: `dvax.vi.ActiveSet` by default.

        **Raises:** `dvax.InputError` where a history is given as a function of time and no depth.
        """
        given = self.final if indentation is None else indentation
        if given is None:
            raise _refused(
                "indentation", "a history and, for the equilibrium, no depth",
                "a history need not come to rest", "Call equilibrium(depth) with a depth to hold",
            )  # fmt: skip
        depth = _tree.as_float(given, "indentation")
        law = Law(
            self.trace, self.weights, self.gap - self.lean * depth,
            self.beta / (1.0 + self.b_u), self.kappa0,
        )  # fmt: skip
        found = at_rest(law, float(self.body.compliance[0]), solver, tol)
        x = -jnp.sqrt(self.tau) * ((self.weights * found.y) @ self.trace)
        return Equilibrium(found.y, x, found)

    def figures(self, pressure: Any) -> dict[str, float]:
        """The headline figures of a pressure on Γ_C: `force`, the resultant against the punch, in
        [p][x]; `contact_half_width`, half of the way between the outermost points under pressure;
        `saturated_length`, the measure of the points at κ₀, in [x]; `peak_pressure`, in [p]."""
        p, w, s = np.asarray(pressure), self.body.weights, self.body.points[:, 0]
        under = s[p > 0]
        return {
            "force": float(np.sum(w * self.body.normals[:, 1] * p)),
            "contact_half_width": 0.5 * float(np.ptp(under)) if under.size else 0.0,
            "saturated_length": float(np.sum(w[p >= float(self.kappa0)])),
            "peak_pressure": float(p.max()),
        }

    def displacement(self, x: Any) -> np.ndarray:
        """The displacement of every node of the body, (n, 2), for a state x; its part in ker γ_ν, which
        a body that was at rest has not, left out."""
        return self.body.displacement(np.asarray(x) / math.sqrt(float(self.tau)))

    def stress(self, t: Any, x: Any) -> np.ndarray:
        """The means over the elements of the stress ℬε(x) + 𝒜ε(x'), elastic and viscous: σ_xx, σ_yy,
        σ_zz, σ_xy. With 𝒜 = τℬ it balances p(t) as an elastic stress at rest would."""
        return self.body.stress(self.body.pushed(self.pressure(t, x)))

    def write(self, path: str | os.PathLike[str], t: Any, x: Any) -> tuple[Path, Path]:
        """The fields at time t as two files that ParaView opens, .vtu or .vtk: the body with its
        displacement and stress, and beside it, "-contact" in its name, the points of Γ_C with
        pressure, penetration and regime. Returns the two paths."""
        contact = {
            "pressure": np.asarray(self.pressure(t, x)),
            "penetration": np.asarray(self.penetration(t, x)),
            "regime": np.asarray(self.regimes(t, x), np.int32),
        }
        return write(self.body, Path(path), self.displacement(x), self.stress(t, x), contact)

    def _drive(self, t: Any, x: Any) -> jax.Array:
        return self.beta / (1.0 + self.b_u) * self.penetration(t, x)


class _Push(eqx.Module):
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
    lean: jax.Array
    depth: AbstractSignal
    tau: jax.Array
    b_u: jax.Array

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        seen = (self.trace @ x) / jnp.sqrt(self.tau)
        return seen - self.gap + self.lean * self.depth(t) - self.b_u * u


class _Ramp(eqx.Module):
    """δ(t), straight up to its end and constant from there."""

    depth: jax.Array
    time: float = eqx.field(static=True)

    def __call__(self, t: Any) -> jax.Array:
        return self.depth * jnp.minimum(t / self.time, 1.0)


def _history(value: Any, ramp: Any) -> tuple[AbstractSignal, jax.Array | None]:
    """δ(t), and its last value where that is known."""
    if isinstance(value, AbstractSignal) or callable(value):
        if ramp is not None:
            raise _refused("ramp", repr(ramp), "a history of indentation has its own times",
                           "Leave it out")  # fmt: skip
        return value if isinstance(value, AbstractSignal) else Function(value), None
    depth = _number("indentation", value)
    time = RAMP if ramp is None else ramp
    if isinstance(time, bool) or not isinstance(time, int | float) or not 0 < time < math.inf:
        raise _refused("ramp", repr(time), "it must be a positive number, a time",
                       "Give a short one for a sudden indentation")  # fmt: skip
    return Function(_Ramp(depth, float(time)), knots=[float(time)]), depth


_RULES: dict[str, tuple[Any, str]] = {
    "stiffness": (lambda v: 0 < v < math.inf, "it must be a positive number, the compliance's 1/β > 0 "
                  "being what makes the law strongly monotone"),
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
        raise _refused(name, f"an array of shape {jnp.shape(number)}", rule, "Give one number")
    if _tree.is_concrete(number) and not holds(float(number)):
        raise _refused(name, f"{float(number):g}", rule, "Fix the value, or its unit")
    return number


def _refused(name: str, given: str, rule: str, fix: str) -> InputError:
    return input_error(f"dvax.models.FemContact({name})", given, rule, fix)
