"""Saturated normal contact on a boundary Γ_C (paper, Section 7)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .. import _tree
from ..errors import Problems
from ..generators import Scalar
from ..operators import Scaling
from ..problem import Problem
from ..sets import Box
from ..signals import AbstractSignal, as_signal
from ..spaces import L2, AbstractSpace
from ..theory import Constants
from ..vi import natural_residual
from ._numbers import positive

UNLOADED, ACTIVE, SATURATED = 0, 1, 2
"""The three regimes of eq:concrete_contact_states."""


class Contact(eqx.Module):
    """Normal contact with a compliant boundary of finite pressure capacity.

        x' = ℓ(t) − (α + d_x) x − d_u u                 (eq:concrete_state)
        u ∈ g(t) − b_x x − b_u u − N_K(β u)             (eq:concrete_contact_law)
        K = {0 ≤ p ≤ κ₀},  p = β u                      (eq:concrete_contact_K)

    at every point s of Γ_C. x is the indentation, positive toward the foundation; g the indentation
    demand; u the normalised reaction; p the pressure, compression positive; ℓ the rate at which a
    load drives the indentation.

    **Units.** With indentation in [x] and pressure in [p] and time in [t]: α, d_x, d_u in 1/[t];
    b_x, b_u are pure numbers; β in [p]/[x]; κ₀ in [p]; g in [x]; ℓ in [x]/[t].

    **Arguments:**

    - `alpha`, `beta`, `b_x`, `d_x`, `d_u`, `kappa0` > 0 and `b_u` ≥ 0, real numbers;
    - `g`, `ell`: numbers, arrays over the points, `dvax.signals`, or callables of t;
    - `weights`: quadrature weights of the points, whose sum is the measure of Γ_C; None for a
      single point or for plain vectors.

    **Raises:** `dvax.InputError` with all invalid parameters.

    All constants have closed forms (`constants`), which Section 7 proves.

    ```python
    >>> import dvax
    >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
    ...                             kappa0=0.5, g=1.0, ell=3.0)
    >>> float(model.constants.L), float(model.constants.L_tilde)
    (1.0, 1.5)
    >>> int(model.regimes(0.0, -1.0))        # saturated
    2

    ```
    """

    alpha: jax.Array
    beta: jax.Array
    b_x: jax.Array
    b_u: jax.Array
    d_x: jax.Array
    d_u: jax.Array
    kappa0: jax.Array
    g: AbstractSignal
    ell: AbstractSignal
    space: AbstractSpace | None

    def __init__(
        self,
        *,
        alpha: Any,
        beta: Any,
        b_x: Any,
        b_u: Any,
        d_x: Any,
        d_u: Any,
        kappa0: Any,
        g: Any,
        ell: Any,
        weights: Any = None,
    ):
        given = {
            "alpha": alpha, "beta": beta, "b_x": b_x, "b_u": b_u, "d_x": d_x, "d_u": d_u,
            "kappa0": kappa0,
        }  # fmt: skip
        wrong = Problems()
        for name, value in given.items():
            number = positive(
                f"dvax.models.Contact({name})", value, wrong, zero=name == "b_u",
                why="paper, Section 7", fix="Express a dependence on space or time by g or ell",
            )  # fmt: skip
            setattr(self, name, number)
        self.space = None
        for name, make in (
            ("g", lambda: _signal(g, "g")),
            ("ell", lambda: _signal(ell, "ell")),
            ("space", lambda: None if weights is None else L2(weights)),
        ):
            with wrong.collect():
                setattr(self, name, make())
        wrong.raise_any()

    @property
    def problem(self) -> Problem:
        """The problem with A = −αI, P = βI, K = [0, κ₀], eq:concrete_f and eq:concrete_h."""
        return Problem(
            A=Scalar(-_tree.host(self.alpha)),
            P=Scaling(self.beta),
            K=Box(0.0, self.kappa0),
            f=_Rate(self.ell, self.d_x, self.d_u),
            h=_Feedback(self.g, self.b_x, self.b_u),
            state_space=self.space,
        )

    @property
    def constants(self) -> Constants:
        """The proved constants of the problem.

        γ_c = L_F = (1+b_u)/β, α_h = b_x, β_h = b_u, α_f = d_x, β_f = d_u, M = 1 and ω = −α. At every
        point −d_x ≤ ∂f̃/∂x ≤ −d_x + d_u b_x/(1+b_u), so the one-sided rate is
        μ = −(α + d_x − d_u b_x/(1+b_u)); the bound of the paper, with |d_x|, is −(α − d_x − …)."""
        alpha, beta, b_x, b_u, d_x, d_u = _tree.host(
            (self.alpha, self.beta, self.b_x, self.b_u, self.d_x, self.d_u)
        )
        modulus = (1.0 + b_u) / beta
        return Constants(
            gamma=modulus,
            L_F=modulus,
            alpha_h=b_x,
            beta_h=b_u,
            alpha_f=d_x,
            beta_f=d_u,
            M=1.0,
            omega=-alpha,
            m_P=1.0 / beta,
            norm_P_inv=1.0 / beta,
            one_sided=-(alpha + d_x - d_u * b_x / (1.0 + b_u)),
            status="proved",
        )

    def drive(self, t: Any, x: Any) -> jax.Array:
        """Return the effective contact drive q = g(t) − b_x x (eq:concrete_drive), in [x]."""
        return self.g(t) - self.b_x * x

    def pressure(self, t: Any, x: Any) -> jax.Array:
        """Return p = proj_{[0,κ₀]}(β q/(1+b_u)) (eq:concrete_pressure_law), in [p]."""
        return jnp.clip(self.beta / (1.0 + self.b_u) * self.drive(t, x), 0.0, self.kappa0)

    def regimes(self, t: Any, x: Any) -> jax.Array:
        """Return 0 where unloaded (q ≤ 0), 1 where active, 2 where saturated (q ≥ (1+b_u)κ₀/β).

        Source: eq:concrete_contact_states."""
        q = self.drive(t, x)
        full = (1.0 + self.b_u) / self.beta * self.kappa0
        regime = jnp.where(q <= 0.0, UNLOADED, jnp.where(q >= full, SATURATED, ACTIVE))
        return regime.astype(jnp.int8)

    def residual(self, tau: Any, t: Any, x: Any, y: Any) -> jax.Array:
        """Return R_τ(t, x, y) = y − proj_K(y − τF(y)), zero exactly at the pressure (τ > 0)."""
        problem = self.problem
        x, y = _tree.as_float(x, "x"), _tree.as_float(y, "y")
        space = problem.spaces(y)[1]
        return natural_residual(problem.frozen(t, x), Box(0.0, self.kappa0), space, y, tau)


class _Rate(eqx.Module):
    """f = ℓ(t) − d_x x − d_u u."""

    ell: AbstractSignal
    d_x: jax.Array
    d_u: jax.Array

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return self.ell(t) - self.d_x * x - self.d_u * u


class _Feedback(eqx.Module):
    """h = g(t) − b_x x − b_u u."""

    g: AbstractSignal
    b_x: jax.Array
    b_u: jax.Array

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return self.g(t) - self.b_x * x - self.b_u * u


def _signal(value: Any, name: str) -> AbstractSignal:
    return as_signal(value, lambda v: _tree.as_float(v, f"dvax.models.Contact({name})"))
