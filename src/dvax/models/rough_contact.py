"""A viscoelastic layer under a rough rigid body."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from ..errors import Problems, input_error
from ..generators import Scalar
from ..operators import Convolution
from ..problem import Problem
from ..sets import Box
from ..signals import AbstractSignal, as_signal
from ..spaces import L2
from ..theory import Constants
from ..vi import ActiveSet, VISolution, solve_vi
from ._numbers import positive


class RoughContact(eqx.Module):
    """A viscoelastic layer on a smooth rigid base, pressed by a rough rigid body, periodic.

        τx' = −x + cu,    u ∈ δ(t) + r − x − N_K(Pu),    K = {0 ≤ p ≤ κ₀},    p = Pu

    on a periodic cell of one dimension (plane strain) or two. r is the height of the body towards the
    layer, with 0 at its highest point; δ its approach; u + x the displacement of the surface, u at once
    and x by creep. The law says: where the pressure p is 0 the body does not penetrate, u + x ≥ δ + r,
    and where p > 0 it touches the surface, up to the hardness κ₀. The pressure of all points moves each
    point: P multiplies a wave of the number k by

        σ(k) = ½E*k (sinh 2kH + 2kH)/(cosh 2kH − 1),    σ(0) = E*/H,

    for the thickness H. For kH ≫ 1 that is ½E*k, the elastic half-space. A constant pressure p causes
    the displacement p(1 + c(1 − e^{−t/τ}))/E* H (a standard linear solid).

    **The state.** The model has the state √P x, whose squared norm in L² is twice the energy of x. In
    this norm any two trajectories approach with the rate 1/τ (docs/models/rough-contact.md);
    `creep(state)` is x.

    **Units:** profile, lengths, H and δ in [s]; E* and κ₀ in [p]; τ in [t].

    **Arguments:** `profile` r: an array over the cell's grid, of which the largest entry becomes 0;
    `lengths` of the cell: a number, or one for each direction; `modulus` E* = E/(1 − ν²);
    `thickness` H; `approach` δ: a number, one of `dvax.signals`, or a callable of t; `creep` c ≥ 0;
    `retardation_time` τ; `hardness` κ₀, by default ∞.

    **Raises:** `dvax.InputError` with all invalid arguments.

    Source of σ: Johnson 1985, Contact Mechanics, for the half-space; Carbone and Mangialardi 2008, J.
    Mech. Phys. Solids 56, 684–706, for a layer on a base without friction.

    ```python
    >>> import jax, jax.numpy as jnp, dvax
    >>> jax.config.update("jax_enable_x64", True)
    >>> s = jnp.arange(256) / 256
    >>> model = dvax.models.RoughContact(profile=jnp.cos(2 * jnp.pi * s), lengths=1.0, modulus=1.0,
    ...                                  thickness=4.0, approach=3.0, creep=1.0)
    >>> rest = model.equilibrium()
    >>> print(f"{float(rest.y.mean()):.4f} on {float((rest.y > 0).mean()):.2f} of the surface")
    0.3103 on 0.29 of the surface

    ```
    """

    profile: jax.Array
    approach: AbstractSignal
    operator: Convolution
    root: Convolution
    creep_ratio: jax.Array
    retardation_time: jax.Array
    hardness: jax.Array
    space: L2
    lengths: tuple[float, ...] = eqx.field(static=True)

    def __init__(
        self,
        *,
        profile: Any,
        lengths: Any,
        modulus: Any,
        thickness: Any,
        approach: Any,
        creep: Any = 0.0,
        retardation_time: Any = 1.0,
        hardness: Any = math.inf,
    ):
        wrong, name = Problems(), "dvax.models.RoughContact"
        heights = _profile(f"{name}(profile)", profile, wrong)
        sides = _lengths(f"{name}(lengths)", lengths, max(heights.ndim, 1), wrong)
        stiffness = positive(f"{name}(modulus)", modulus, wrong)
        depth = positive(f"{name}(thickness)", thickness, wrong)
        self.creep_ratio = positive(f"{name}(creep)", creep, wrong, zero=True)
        self.retardation_time = positive(f"{name}(retardation_time)", retardation_time, wrong)
        self.hardness = _hardness(f"{name}(hardness)", hardness, wrong)
        with wrong.collect():
            self.approach = as_signal(approach, _finite_number)
        wrong.raise_any()
        self.profile = heights - jnp.max(heights)
        self.lengths = sides
        symbol = layer_symbol(heights.shape, sides, stiffness, depth)
        self.operator = Convolution(symbol, heights.shape)
        self.root = Convolution(jnp.sqrt(symbol), heights.shape)
        self.space = L2(jnp.full(heights.shape, math.prod(sides) / heights.size))

    @property
    def fit(self) -> str:
        """How the model relates to the class of the theory."""
        return "exact"

    @property
    def problem(self) -> Problem:
        """The problem with A = −I/τ, P, K = [0, κ₀], f = c√P u/τ and h = δ + r − √P⁻¹ x, in L²."""
        return Problem(
            A=Scalar(-1.0 / _tree.host(self.retardation_time)),
            P=self.operator,
            K=Box(0.0, self.hardness),
            f=self._rate,
            h=self._penetration,
            state_space=self.space,
            control_space=self.space,
        )

    @property
    def constants(self) -> Constants:
        """The proved constants.

        With the least and the largest σ: γ = 1/σ_max, L_F = 1/σ_min, α_h = √(1/σ_min), β_h = α_f = 0,
        β_f = (c/τ)√σ_max, M = 1, ω = −1/τ. The one-sided rate is μ = −1/τ: of two solutions with
        differences d and v of states and responses, ⟨−√P⁻¹ d − v, Pv⟩ ≥ 0 since N_K is monotone, so
        that ⟨(c/τ)√P v, d⟩ ≤ −(c/τ)⟨v, Pv⟩ ≤ 0."""
        spectrum = self.operator.spectrum(self.space)
        tau, creep = _tree.host((self.retardation_time, self.creep_ratio))
        return Constants(
            gamma=spectrum.m_P,
            L_F=spectrum.norm_P_inv,
            alpha_h=spectrum.norm_P_inv**0.5,
            beta_h=0.0,
            alpha_f=0.0,
            beta_f=creep / tau * spectrum.norm**0.5,
            M=1.0,
            omega=-1.0 / tau,
            m_P=spectrum.m_P,
            norm_P_inv=spectrum.norm_P_inv,
            one_sided=-1.0 / tau,
            status="proved",
        )

    @property
    def untouched(self) -> jax.Array:
        """The state without creep, zeros."""
        return jnp.zeros_like(self.profile)

    def creep(self, state: Any) -> jax.Array:
        """Return the displacement x by creep for a state √P x."""
        return self.root.inverse(state)

    def equilibrium(
        self, approach: Any = None, *, relaxed: bool = True, guess: Any = None, tol: Any = None
    ) -> VISolution:
        """Return the pressure at rest as the solution of VI(K, F), F(p) = (1 + c)P⁻¹p − δ − r.

        `approach` δ is by default that of the model at t = 0; `relaxed=False` is the pressure at once,
        c = 0. `guess` is a pressure to start from. `tol` bounds the error of p in L², by default a
        millionth of a pressure E*|δ|/H over the whole cell.
        """
        depth = self.approach(0.0) if approach is None else _tree.as_float(approach, "approach")
        compliance = 1.0 + (self.creep_ratio if relaxed else 0.0)
        start = self.untouched if guess is None else _tree.as_float(guess, "guess")
        if tol is None:
            scale = jnp.sqrt(jnp.sum(self.space.w)) * jnp.abs(depth) / compliance
            tol = 1e-6 * self.operator.symbol.ravel()[0] * scale
        law = _Equilibrium(self.operator, compliance)
        spectrum = self.operator.spectrum(self.space)
        return solve_vi(
            law, Box(0.0, self.hardness), start, depth + self.profile, tol=tol,
            gamma=compliance * spectrum.m_P, L_F=compliance * spectrum.norm_P_inv, space=self.space,
            solver=ActiveSet(symmetric=True, preconditioner=law.approximate_inverse),
        )  # fmt: skip

    def figures(self, pressure: Any) -> dict[str, float]:
        """Return the results for a pressure over the cell.

        `mean_pressure`: the load over the area of the cell, in [p]; `contact_area`: the fraction of
        the points with p > 0; `saturated_area`: with p = κ₀; `peak_pressure`, in [p]."""
        p = np.asarray(pressure)
        return {
            "mean_pressure": float(p.mean()),
            "contact_area": float(np.mean(p > 0)),
            "saturated_area": float(np.mean(p >= float(self.hardness))),
            "peak_pressure": float(p.max()),
        }

    def _rate(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return self.root.apply(self.creep_ratio / self.retardation_time * u)

    def _penetration(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return self.approach(t) + self.profile - self.root.inverse(x)


class _Equilibrium(eqx.Module):
    """F(p) = (1 + c)P⁻¹p − (δ + r)."""

    operator: Convolution
    compliance: Any

    def __call__(self, p: Any, drive: Any) -> jax.Array:
        return self.compliance * self.operator.inverse(p) - drive

    def approximate_inverse(self, free: Any, r: Any) -> jax.Array:
        """Return the block of P at the free points, applied to r: up to a factor close to F′_II⁻¹."""
        return jnp.where(free, self.operator.apply(r), 0.0)


def layer_symbol(
    shape: tuple[int, ...], lengths: tuple[float, ...], modulus: Any, thickness: Any
) -> jax.Array:
    """Return σ at the wave numbers of `rfftn`, for an elastic layer on a smooth rigid base."""
    axes = [
        2 * np.pi * (np.fft.rfftfreq if axis == len(shape) - 1 else np.fft.fftfreq)(n, side / n)
        for axis, (n, side) in enumerate(zip(shape, lengths, strict=True))
    ]
    k = np.sqrt(sum(part**2 for part in np.meshgrid(*axes, indexing="ij")))
    # (sinh 2q + 2q)/(cosh 2q − 1) with numerator and denominator times 2e^{−2q}, and its limit 2/q.
    q = jnp.asarray(k) * thickness
    decay = jnp.exp(-2.0 * q)
    top, bottom = 1.0 - decay**2 + 4.0 * q * decay, (1.0 - decay) ** 2
    short = jnp.asarray(k) > 0
    ratio = top / jnp.where(short, bottom, 1.0)
    return modulus * jnp.where(short, 0.5 * jnp.asarray(k) * ratio, 1.0 / thickness)


def _profile(place: str, value: Any, wrong: Problems) -> jax.Array:
    with wrong.collect():
        heights = _tree.as_array(value, place)
        concrete = _tree.is_concrete(heights)
        if heights.ndim in (1, 2) and not (concrete and _tree.first_nonfinite(heights)):
            return heights
        wrong.add(
            place, _tree.short(heights),
            "it must be an array of one or two dimensions of finite heights",
            "Give the heights over the grid of the cell",
        )  # fmt: skip
    return jnp.zeros(2)


def _lengths(place: str, value: Any, count: int, wrong: Problems) -> tuple[float, ...]:
    given = np.asarray(value, float) if _is_numeric(value) else np.full(1, np.nan)
    if given.shape in ((), (count,)) and np.all(np.isfinite(given)) and np.all(given > 0):
        return tuple(float(side) for side in np.broadcast_to(given, (count,)))
    wrong.add(
        place, _tree.line(value), f"it must be a positive number, or {count} of them",
        "Give the length of the cell in each direction of the profile",
    )  # fmt: skip
    return (1.0,) * count


def _is_numeric(value: Any) -> bool:
    try:
        np.asarray(value, float)
    except (TypeError, ValueError):
        return False
    return True


def _hardness(place: str, value: Any, wrong: Problems) -> jax.Array:
    if isinstance(value, float) and value == math.inf:
        return jnp.asarray(math.inf)
    return positive(place, value, wrong, fix="Give a pressure, or leave it out for none")


def _finite_number(value: Any) -> jax.Array:
    place = "dvax.models.RoughContact(approach)"
    number = _tree.as_float(value, place)
    is_number = jnp.ndim(number) == 0
    if not is_number or (_tree.is_concrete(number) and not np.isfinite(number)):
        raise input_error(
            place, _tree.short(number), "it must be a finite number or a function of t",
            "Give the approach in the unit of the profile",
        )  # fmt: skip
    return number
