"""Section 6 of the paper: bounds on the change of solutions with initial state and parameter."""

from typing import Any

import equinox as eqx
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._repr import table, value_text
from .._tree import Tree
from ..errors import Problems
from .constants import Constants
from .formulas import growth_integral
from .status import Status, weakest


class ParameterSet(eqx.Module):
    """low ≤ η ≤ high entry by entry, t0 ≤ t ≤ t1, and ‖ζ‖ ≤ start_radius unless that is None."""

    low: Tree
    high: Tree
    t0: float
    t1: float
    start_radius: float | None

    def contains(self, args: Any) -> bool:
        """Return whether these parameters lie in the box."""
        trees = (self.low, args, self.high)
        low, at, high = (jtu.tree_leaves(tree) for tree in trees)
        if not len(low) == len(at) == len(high):
            return False
        ends = zip(low, at, high, strict=True)
        return all(bool(np.all((a <= v) & (v <= b))) for a, v, b in ends)


class ParameterBounds(eqx.Module):
    """Bounds on solutions on [0, T] for all parameters η in a bounded set D (paper, Section 6).

    **Arguments** (paper's symbol, ass:parametrized_data):

    - `constants`: moduli that hold for every η ∈ D: α_f(D), β_f(D), α_h(D), γ(D), L_F(D), (ii), (v);
    - `T`: the length of time;
    - `kappa_K` = sup_t ‖proj_{K(t)} 0‖;
    - `C_h0` ≥ ‖h(t, 0, 0, η)‖, `C_f0` ≥ ‖f(t, 0, 0, η)‖, (vi), (vii);
    - `modulus_f`, `modulus_h`: numbers ℓ with ‖f(t,x,u,η₁) − f(t,x,u,η₂)‖ ≤ ℓ_f ‖η₁ − η₂‖, and the same
      for h, (iii);
    - `status`: the status of those five;
    - `domain`: the box, the times and the initial states for which they hold, from
      `dvax.parameter_bounds`; None if not stated.

    Distances of parameters are in the norm to which `modulus_f` and `modulus_h` refer.

    ```python
    >>> import dvax
    >>> c = dvax.Constants(gamma=2.0, L_F=2.0, alpha_h=2.0, beta_h=1.0, alpha_f=0.5, beta_f=1.0,
    ...                    M=1.0, omega=-1.0, m_P=1.0, norm_P_inv=1.0, one_sided=-0.5)
    >>> bounds = dvax.ParameterBounds(c, T=2.0, kappa_K=0.0, C_h0=1.0, C_f0=3.0, modulus_f=1.0,
    ...                               modulus_h=0.0)
    >>> round(float(bounds.state(0.0, 0.1)), 6)        # Φ_{1/2}(2) · 0.1
    0.343656
    >>> round(float(bounds.sharp_state(0.0, 0.1)), 6)  # Φ_{−1/2}(2) · 0.1
    0.126424

    ```
    """

    constants: Constants
    T: Any
    kappa_K: Any
    C_h0: Any
    C_f0: Any
    modulus_f: Any
    modulus_h: Any
    domain: ParameterSet | None
    data_status: Status = eqx.field(static=True)

    def __init__(
        self,
        constants: Constants,
        *,
        T: Any,
        kappa_K: Any,
        C_h0: Any,
        C_f0: Any,
        modulus_f: Any,
        modulus_h: Any,
        status: Status = "declared",
        domain: ParameterSet | None = None,
    ):
        self.constants, self.data_status, self.domain = constants, status, domain
        problems = Problems()
        values = dict(
            T=T, kappa_K=kappa_K, C_h0=C_h0, C_f0=C_f0, modulus_f=modulus_f, modulus_h=modulus_h
        )
        for name, value in values.items():
            number = _tree.as_float(value, f"dvax.ParameterBounds({name})")
            setattr(self, name, number)
            if _tree.is_concrete(number) and not (np.ndim(number) == 0 and float(number) >= 0):
                problems.add(
                    f"dvax.ParameterBounds({name})", _tree.short(number),
                    "it must be one number ≥ 0", "Give a bound on it, or ∞ if none is known",
                )  # fmt: skip
        problems.raise_any()

    def __repr__(self) -> str:
        names = ("T", "kappa_K", "C_h0", "C_f0", "modulus_f", "modulus_h")
        rows = [(name, value_text(getattr(self, name))) for name in names]
        return f"{table(f'ParameterBounds: {self.status}', rows)}\n{self.constants!r}"

    @property
    def status(self) -> Status:
        """The weakest status among the quantities in these bounds."""
        c = self.constants
        return weakest(self.data_status, c.status_of(*(name for name, _ in c.statuses)))

    @property
    def L(self) -> Any:
        """L(D) = α_h(D)‖P⁻¹‖/γ(D) (lem:parametrized_state_to_control)."""
        return self.constants.L

    @property
    def L_tilde(self) -> Any:
        """L̃(D) = α_f(D) + β_f(D)L(D) (lem:parametrized_reduced_stability)."""
        return self.constants.L_tilde

    def response_radius(self, R: Any) -> Any:
        """Return R̂(D, R) with ‖u_x^η(t)‖ ≤ R̂ for ‖x‖ ≤ R
        (cor:parametrized_state_to_control_bound)."""
        v, c = _tree.host(self), _tree.host(self.constants)
        norm_F = c.alpha_h * R + v.C_h0 + (2.0 * c.norm_P_inv + c.L_F) * v.kappa_K
        return c.norm_P_inv * (v.kappa_K + norm_F / c.gamma)

    def state_radius(self, R_initial: Any) -> Any:
        """Return R_B^x with ‖x(t)‖ ≤ R_B^x on [0, T] for ‖ζ‖ ≤ R_Λ (lem:parametrized_apriori)."""
        v, c = _tree.host(self), _tree.host(self.constants)
        lib = _tree.array_module(self, R_initial)
        forcing = c.beta_f * self.response_radius(0.0) + v.C_f0
        start = c.M * R_initial + c.M * forcing * growth_integral(-c.omega, v.T)
        return lib.exp(lib.maximum(c.omega, 0.0) * v.T) * start * lib.exp(c.M * self.L_tilde * v.T)

    def radius(self, R_initial: Any) -> Any:
        """Return R_B = max(R_B^x, R̂(D, R_B^x)), a bound on ‖x‖ and ‖u‖ (lem:parametrized_apriori)."""
        lib = _tree.array_module(self, R_initial)
        of_state = self.state_radius(R_initial)
        return lib.maximum(of_state, self.response_radius(of_state))

    def response(self, gap_x: Any, gap: Any) -> Any:
        """Return a bound on ‖u_{x₁}^{η₁} − u_{x₂}^{η₂}‖ for ‖x₁ − x₂‖ ≤ gap_x, ‖η₁ − η₂‖ ≤ gap
        (cor:parametrized_state_to_control_compare)."""
        v, c = _tree.host(self), _tree.host(self.constants)
        return c.norm_P_inv / c.gamma * (c.alpha_h * gap_x + v.modulus_h * gap)

    def modulus(self, gap: Any) -> Any:
        """Return Θ(‖η₁ − η₂‖), which bounds the change of the reduced map
        (eq:reduced_parameter_modulus)."""
        v, c = _tree.host(self), _tree.host(self.constants)
        return (c.beta_f * c.norm_P_inv / c.gamma * v.modulus_h + v.modulus_f) * gap

    def state(self, gap_start: Any, gap: Any) -> Any:
        """Return the bound M e^{(ω+ML̃)₊T}‖Δζ‖ + M Φ_{ω+ML̃}(T) Θ on max_t ‖x₁ − x₂‖
        (thm:parametrized_continuity)."""
        c = _tree.host(self.constants)
        return self._separation(c.M, c.growth_rate, gap_start, gap)

    def control(self, gap_start: Any, gap: Any) -> Any:
        """Return the bound ‖P⁻¹‖ℓ_h‖Δη‖/γ + L max_t ‖x₁ − x₂‖ on max_t ‖u₁ − u₂‖
        (thm:parametrized_continuity)."""
        return self.response(self.state(gap_start, gap), gap)

    def sharp_state(self, gap_start: Any, gap: Any) -> Any:
        """Return `state` with the one-sided constant, e^{μ₊T}‖Δζ‖ + Φ_μ(T)Θ, or None if μ is unknown.

        It follows from d/dt ‖Δx‖ ≤ μ‖Δx‖ + Θ.
        """
        mu = self.constants.one_sided
        return None if mu is None else self._separation(1.0, _tree.host(mu), gap_start, gap)

    def sharp_control(self, gap_start: Any, gap: Any) -> Any:
        """Return `control` from `sharp_state`, or None if μ is unknown."""
        separation = self.sharp_state(gap_start, gap)
        return None if separation is None else self.response(separation, gap)

    def _separation(self, M: Any, rate: Any, gap_start: Any, gap: Any) -> Any:
        v, lib = _tree.host(self), _tree.array_module(self, gap_start, gap)
        from_start = M * lib.exp(lib.maximum(rate, 0.0) * v.T) * gap_start
        return from_start + M * growth_integral(rate, v.T) * self.modulus(gap)
