"""Duvaut–Lions viscoplasticity at a material point."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from .. import _tree
from ..errors import InputError, Problems
from ..generators import Scalar
from ..operators import Scaling
from ..problem import Problem
from ..sets import AbstractSet, Ball, SecondOrderCone, Translated
from ..signals import AbstractSignal, Constant, as_signal
from ..spaces import L2
from ..theory import Constants
from ._numbers import positive
from ._stress import join, split
from ._stress import mandel as mandel
from ._stress import tensor as tensor


class VonMises(NamedTuple):
    """The yield condition √(3/2)‖dev σ‖ ≤ σ_y.

    `strength` is σ_y > 0: a number, a `dvax.signals` or a callable of t.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> from dvax.models.duvaut_lions import mandel
    >>> law = dvax.models.VonMises(250.0)          # MPa
    >>> shear = mandel(jnp.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    >>> point = dvax.models.DuvautLions(bulk=160e3, shear=80e3, relaxation=0.1, yields=law,
    ...                                 strain=lambda t: 1e-3 * t * shear)
    >>> sol = dvax.solve(point.problem, point.virgin, 0.0, 4.0)
    >>> print(f"{float(point.stress(4.0, sol.xs[-1])[5] / 2**0.5):.2f}")
    160.34

    ```
    """

    strength: Any


class DruckerPrager(NamedTuple):
    """The yield condition √(3/2)‖dev σ‖ ≤ M (p + p_t) with the pressure p = −tr σ/3: a cone.

    `friction` is M > 0, a number. `tension` is the hydrostatic tensile strength p_t ≥ 0: a number, a
    `dvax.signals` or a callable of t.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> from dvax.models.duvaut_lions import mandel
    >>> law = dvax.models.DruckerPrager(friction=0.9, tension=50.0)          # MPa
    >>> shear = mandel(jnp.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    >>> point = dvax.models.DuvautLions(bulk=160e3, shear=80e3, relaxation=0.1, yields=law,
    ...                                 strain=lambda t: 1e-3 * t * shear)
    >>> sol = dvax.solve(point.problem, point.virgin, 0.0, 4.0)
    >>> print(f"{float(point.stress(4.0, sol.xs[-1])[5] / 2**0.5):.2f}")
    251.68

    ```
    """

    friction: float
    tension: Any


class DuvautLions(eqx.Module):
    """A viscoplastic material point under a prescribed strain history ε(t).

        ε_p' = C⁻¹(σ − u)/τ,   σ = C(ε(t) − ε_p),   u = proj_K(σ) in the norm σ : C⁻¹ : σ

    ε_p is the plastic strain, σ the stress, and u the nearest admissible stress. C is isotropic,
    C e = K tr(e) 1 + 2G dev e. The projection in the energy norm is the closest-point projection of
    computational plasticity: C⁻¹(σ − u) is normal to K at u, so the flow is associated. As τ → 0 the
    stress converges to that of rate-independent plasticity, with an error of order τ.

    In `split` components of Mandel vectors (the trace and five components of the deviator) C is
    diagonal, c = (3K, 2G, …, 2G). The state is ε_p in the norm with weights c, and the control is u in
    the norm with weights 1/c; both are elastic energies. The problem has A = −1/τ, P = I,
    h = c(ε − x) and f = (ε − u/c)/τ. K is

    - the Drucker–Prager cone, a translated `dvax.sets.SecondOrderCone`, projected with these weights:
      six components;
    - the von Mises cylinder. Since σ : C⁻¹ : σ = (tr σ)²/(9K) + ‖dev σ‖²/(2G) and K does not restrict
      the trace, the projection leaves the trace unchanged and scales the deviator (radial return). The
      pressure is elastic, and state and control are the five components of the deviators, with a
      `dvax.sets.Ball` of radius σ_y √(2/3)/√(2G) in the energy norm. The law is then
      ε_p' = (σ − u)/η with the viscosity η = 2Gτ.

    **Units:** K, G, σ and strengths in one unit of stress; τ and t in one unit of time.

    **Arguments:** `bulk` K > 0, `shear` G > 0, `relaxation` τ > 0: numbers; `strain`: ε(t) as a Mandel
    vector (`mandel`), a `dvax.signals` or a callable of t; `yields`: `VonMises(…)` or
    `DruckerPrager(…)`. Use `jax.vmap` for many points.

    **Raises:** `dvax.InputError` with all invalid arguments.

    Source: Duvaut and Lions 1972, chapter V; Simo and Hughes 1998, Computational Inelasticity, sections
    2.7 and 3.6.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> from dvax.models.duvaut_lions import DuvautLions, VonMises, mandel
    >>> shear = mandel(jnp.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    >>> steel = DuvautLions(bulk=160e3, shear=80e3, relaxation=0.1, yields=VonMises(250.0),
    ...                     strain=lambda t: 1e-3 * t * shear)          # MPa and seconds
    >>> sol = dvax.solve(steel.problem, steel.virgin, 0.0, 4.0, rtol=1e-8, atol=1e-12)
    >>> stress = steel.stress(4.0, sol.xs[-1])
    >>> round(float(stress[5] / 2**0.5), 3)              # 250/√3 + 2 · 80e3 · 1e-3 · 0.1
    160.338

    ```
    """

    moduli: jax.Array
    relaxation: jax.Array
    slope: jax.Array | None
    limit: AbstractSignal
    strain: AbstractSignal

    def __init__(self, *, bulk: Any, shear: Any, relaxation: Any, strain: Any, yields: Any):
        wrong = Problems()
        K, G, self.relaxation = (
            positive(f"dvax.models.DuvautLions({name})", value, wrong)
            for name, value in (("bulk", bulk), ("shear", shear), ("relaxation", relaxation))
        )
        self.moduli = jnp.concatenate([jnp.reshape(3.0 * K, (1,)), jnp.full(5, 2.0 * G)])
        self.slope = None
        if isinstance(yields, DruckerPrager):
            # q = √(3/2)‖s‖ ≤ M(p + p_t) and y₀ = √3 p: ‖s‖ ≤ (√2/3) M (y₀ + √3 p_t).
            place = "dvax.models.DuvautLions(yields.friction)"
            self.slope = math.sqrt(2.0) / 3.0 * positive(place, yields.friction, wrong)
            self.limit = _limit("yields.tension", yields.tension, wrong, zero=True)
        elif isinstance(yields, VonMises):
            self.limit = _limit("yields.strength", yields.strength, wrong, zero=False)
        else:
            wrong.add(
                "dvax.models.DuvautLions(yields)", repr(yields),
                "it must be a VonMises(strength) or a DruckerPrager(friction, tension)",
                "Import them from dvax.models.duvaut_lions",
            )  # fmt: skip
        self.strain = _strain(strain, wrong)
        wrong.raise_any()

    @property
    def fit(self) -> str:
        """How the model relates to the class of the theory."""
        return (
            "exact (rate-independent plasticity is its limit as the relaxation time τ → 0, at O(τ))"
        )

    @property
    def problem(self) -> Problem:
        """The coupled problem, in those `split` components that the yield condition restricts."""
        c = self._active_moduli
        return Problem(
            A=Scalar(-1.0 / _tree.host(self.relaxation)),
            P=Scaling(1.0),
            K=self._yield_set,
            f=self._rate,
            h=self._feedback,
            state_space=L2(c),
            control_space=L2(1.0 / c),
        )

    @property
    def constants(self) -> Constants:
        """The proved constants in the energy norms.

        γ = L_F = 1, α_h = ‖C‖ = 1, β_f = 1/τ, ω = −1/τ, so ω + L̃ = 0. The distance between two
        solutions with the same strain history never increases, and inside the yield set it is
        constant. The one-sided rate is 0 as well, since ⟨Δσ, Δu⟩ ≤ ‖Δσ‖²."""
        rate = 1.0 / _tree.host(self.relaxation)
        return Constants(
            gamma=1.0,
            L_F=1.0,
            alpha_h=1.0,
            beta_h=0.0,
            alpha_f=0.0,
            beta_f=rate,
            M=1.0,
            omega=-rate,
            m_P=1.0,
            norm_P_inv=1.0,
            one_sided=0.0,
            status="proved",
        )

    @property
    def virgin(self) -> jax.Array:
        """The state without plastic strain: five zeros (von Mises) or six."""
        return jnp.zeros_like(self._active_moduli)

    def stress(self, t: Any, x: Any) -> jax.Array:
        """Return σ = C(ε(t) − ε_p), a Mandel vector, at the state x."""
        return join(self.moduli * (split(self.strain(t)) - self._all_components(x)))

    def plastic_strain(self, x: Any) -> jax.Array:
        """Return ε_p as a Mandel vector."""
        return join(self._all_components(x))

    def von_mises(self, t: Any, x: Any) -> jax.Array:
        """Return q = √(3/2)‖dev σ‖, in units of stress."""
        return math.sqrt(1.5) * jnp.linalg.norm(self._trial(t, x)[-5:])

    def figures(self, solution: Any) -> dict[str, Any]:
        """Return the results of a solution.

        Over the saved times, in units of stress: `peak_stress`, the largest q; `overstress`, the
        largest distance ‖σ − u‖ from the yield set. At the last saved time: `final_stress`, a Mandel
        vector, and `plastic_strain`, √(2/3)‖ε_p‖."""
        ts, xs = solution.ts, solution.xs
        trial = jax.vmap(self._trial)(ts, xs)
        return {
            "peak_stress": float(jnp.max(jax.vmap(self.von_mises)(ts, xs))),
            "overstress": float(jnp.max(jnp.linalg.norm(trial - solution.us, axis=-1))),
            "plastic_strain": math.sqrt(2.0 / 3.0) * float(jnp.linalg.norm(xs[-1])),
            "final_stress": [float(v) for v in self.stress(ts[-1], xs[-1])],
        }

    @property
    def _active_moduli(self) -> jax.Array:
        """c of the components of the problem: for von Mises, the five of the deviator."""
        return self.moduli[1:] if self.slope is None else self.moduli

    def _all_components(self, x: Any) -> jax.Array:
        """Return the six components of a state."""
        return jnp.concatenate([jnp.zeros_like(x[:1]), x]) if self.slope is None else x

    def _active_strain(self, t: Any) -> jax.Array:
        """Return the components of ε(t) that are components of the problem."""
        parts = split(self.strain(t))
        return parts[1:] if self.slope is None else parts

    def _trial(self, t: Any, x: Any) -> jax.Array:
        """Return the trial stress c(ε(t) − x)."""
        return self._active_moduli * (self._active_strain(t) - x)

    @property
    def _yield_set(self) -> Any:
        """K, or a callable (t, args) ↦ K if the yield limit depends on time."""
        return self._set(0.0, None) if isinstance(self.limit, Constant) else self._set

    def _set(self, t: Any, args: Any) -> AbstractSet:
        if self.slope is None:
            return Ball(0.0, math.sqrt(2.0 / 3.0) * self.limit(t) / jnp.sqrt(self.moduli[1]))
        apex = jnp.zeros(6).at[0].set(-math.sqrt(3.0) * self.limit(t))
        return Translated(SecondOrderCone(self.slope), apex)

    def _rate(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return (self._active_strain(t) - u / self._active_moduli) / self.relaxation

    def _feedback(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return self._trial(t, x)


def _limit(name: str, value: Any, wrong: Problems, zero: bool) -> AbstractSignal:
    place = f"dvax.models.DuvautLions({name})"
    return as_signal(value, lambda v: positive(place, v, wrong, zero=zero))


def _strain(value: Any, wrong: Problems) -> AbstractSignal:
    place = "dvax.models.DuvautLions(strain)"
    try:
        signal = as_signal(value, lambda v: _tree.as_float(v, place))
    except InputError as error:
        wrong += error.problems
        return Constant(jnp.zeros(6))
    shape = tuple(jax.eval_shape(signal.value, jnp.zeros(())).shape)
    if shape != (6,):
        wrong.add(
            place, f"values of shape {shape}",
            "a strain must be a Mandel vector of six components",
            "Convert the tensor with dvax.models.duvaut_lions.mandel",
        )  # fmt: skip
    return signal
