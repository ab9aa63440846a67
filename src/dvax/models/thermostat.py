"""Heat conduction with distributed thermostats of limited power."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from ..errors import InputError, Problems
from ..generators import Elliptic
from ..operators import Scaling
from ..problem import Problem
from ..sets import Box
from ..signals import AbstractSignal, as_signal
from ..spaces import L2
from ..theory import Constants
from ._numbers import positive

COOLED, REGULATED, HEATED = -1, 0, 1
"""The regimes: minimal power, intermediate power, maximal power."""


class Thermostat(eqx.Module):
    """The heat equation on a rectangle Ω with a thermostat at every point.

        x' = κΔx − λx + u + ℓ(t)
        u ∈ k(T_ref − x) − N_K(u),   K = {g₁ ≤ u ≤ g₂},   so that u = clip(k(T_ref − x), g₁, g₂)

    in X = U = L²(Ω), with insulated walls (Neumann), walls of temperature 0 (Dirichlet), or periodic
    boundary conditions. u is the heating power, negative for cooling. Free boundaries, on which
    k(T_ref − x) equals a limit, separate the three regimes. (With −u as the flow through a
    semipermeable membrane this is the interior law of Duvaut and Lions.) The loss λ is that to
    surroundings of temperature 0; to those of temperature T(t) it is λx with the load λT(t).

    The problem has A = κΔ − λ, P = I, h = k(T_ref − x) and f = u + ℓ; F(y) = y − h(x) has
    γ = L_F = 1. On a grid the weight of L² is the area of a cell, the projection is the clip, and Δ
    is exact for every function that the grid resolves.

    **Units:** with temperature in [T], length in [s], time in [t]: κ in [s]²/[t]; k and λ in 1/[t];
    u, g₁, g₂ and ℓ in [T]/[t] (power over heat capacity); T_ref in [T].

    **Arguments:** `shape`: cells along each axis; `lengths`; `boundary` and `scheme` as for
    `dvax.generators.Elliptic`; `diffusion` κ > 0; `gain` k > 0; `loss` λ ≥ 0; `reference` T_ref
    and `load` ℓ: numbers, arrays over the cells, `dvax.signals` or callables of t; `lower` g₁ ≤
    `upper` g₂: numbers or arrays over the cells (equal where there is no heater).

    **Raises:** `dvax.InputError` with all invalid arguments.

    Source: Duvaut and Lions 1972, Les inéquations en mécanique et en physique, chapter I.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> from dvax.models.thermostat import Thermostat
    >>> plate = Thermostat(shape=(32, 32), lengths=1.0, boundary="dirichlet", diffusion=0.1, gain=5.0,
    ...                    reference=1.0, lower=0.0, upper=2.0, load=0.0)
    >>> sol = dvax.solve(plate.problem, jnp.zeros((32, 32)), 0.0, 4.0, rtol=1e-4)
    >>> figures = plate.figures(sol)
    >>> round(figures["mean_temperature"], 3), round(figures["heated"], 3)
    (0.496, 0.574)
    >>> bool(plate.constants.sharp_decay_rate > 1.97), float(plate.constants.decay_rate) < 0
    (True, True)

    ```
    """

    diffusion: jax.Array
    gain: jax.Array
    reference: AbstractSignal
    lower: jax.Array
    upper: jax.Array
    load: AbstractSignal
    generator: Elliptic
    space: L2
    lengths: tuple[float, ...] = eqx.field(static=True)

    def __init__(
        self,
        *,
        shape: Any,
        diffusion: Any,
        gain: Any,
        reference: Any,
        lower: Any,
        upper: Any,
        load: Any = 0.0,
        loss: Any = 0.0,
        lengths: Any = 1.0,
        boundary: Any = "neumann",
        scheme: str = "spectral",
    ):
        wrong = Problems()
        name = "dvax.models.Thermostat"
        why = "a negative diffusivity is ill-posed"
        self.diffusion = positive(f"{name}(diffusion)", diffusion, wrong, why=why)
        self.gain = positive(f"{name}(gain)", gain, wrong, why="heating must decrease with x")
        loss_rate = positive(f"{name}(loss)", loss, wrong, zero=True)
        try:
            self.generator = Elliptic(
                shape, lengths, boundary, self.diffusion, reaction=0.0 - loss_rate, scheme=scheme
            )
        except InputError as error:
            # Without a grid the fields cannot be checked.
            raise InputError(*wrong, *error.problems) from error
        cells = self.generator.transform.shape
        for name, value in (("reference", reference), ("load", load)):
            with wrong.collect():
                setattr(self, name, _signal(name, value, cells))
        for name, value in (("lower", lower), ("upper", upper)):
            setattr(self, name, _field(name, value, cells, wrong))
        if not wrong and _tree.is_concrete(self.lower, self.upper):
            low, high = np.asarray(self.lower), np.asarray(self.upper)
            if np.any(low > high):
                at = np.unravel_index(np.argmax(low - high), low.shape)
                wrong.add(
                    "dvax.models.Thermostat(lower, upper)",
                    f"lower = {low[at]:.6g} and upper = {high[at]:.6g} in cell "
                    f"{tuple(int(k) for k in at)}",
                    "lower ≤ upper must hold in every cell", "Swap the bounds there",
                )  # fmt: skip
        wrong.raise_any()
        sides = np.broadcast_to(np.asarray(lengths, float), (len(cells),))
        self.lengths = tuple(float(side) for side in sides)
        self.space = L2(jnp.full(cells, math.prod(self.lengths) / math.prod(cells)))

    @property
    def fit(self) -> str:
        """How the model relates to the class of the theory."""
        return "exact"

    @property
    def problem(self) -> Problem:
        """The coupled problem, in L²(Ω) for x and u."""
        return Problem(
            A=self.generator,
            P=Scaling(1.0),
            K=Box(self.lower, self.upper),
            f=self._rate,
            h=self._feedback,
            state_space=self.space,
        )

    @property
    def constants(self) -> Constants:
        """The proved constants.

        γ = L_F = 1, α_h = k, β_h = α_f = 0, β_f = 1, M = 1, and ω = −κλ₁ − λ with the
        smallest eigenvalue λ₁ of −Δ, which is 0 for insulated walls. The one-sided rate is μ = ω,
        since heating decreases with temperature, ⟨u(x₁) − u(x₂), x₁ − x₂⟩ ≤ 0; the rate of the
        paper, ω + k, ignores this sign."""
        growth = self.generator.growth(self.space)
        return Constants(
            gamma=1.0,
            L_F=1.0,
            alpha_h=self.gain,
            beta_h=0.0,
            alpha_f=0.0,
            beta_f=1.0,
            M=growth.M,
            omega=growth.omega,
            m_P=1.0,
            norm_P_inv=1.0,
            one_sided=growth.omega,
            status="proved",
        )

    @property
    def points(self) -> tuple[np.ndarray, ...]:
        """The coordinates of the cell midpoints, one array an axis."""
        cells = self.generator.transform.shape
        axes = [(np.arange(n) + 0.5) * side / n for n, side in zip(cells, self.lengths)]
        return tuple(np.meshgrid(*axes, indexing="ij"))

    def power(self, t: Any, x: Any) -> jax.Array:
        """Return u = clip(k(T_ref − x), g₁, g₂) in every cell."""
        return jnp.clip(self.gain * (self.reference(t) - x), self.lower, self.upper)

    def regimes(self, t: Any, x: Any) -> jax.Array:
        """Return −1 where u = g₁, 1 where u = g₂ (also if g₁ = g₂), and 0 in between."""
        z = self.gain * (self.reference(t) - x)
        regime = jnp.where(z >= self.upper, HEATED, jnp.where(z <= self.lower, COOLED, REGULATED))
        return regime.astype(jnp.int8)

    def figures(self, solution: Any) -> dict[str, float]:
        """Return the results at the last saved time.

        `mean_temperature`; `power`: the integral of u over Ω; `heated`, `regulated` and `cooled`: the
        fraction of Ω in each regime; `decay_rate`: the proved rate at which the distance of any two
        states decreases."""
        t, x, u = (jax.tree_util.tree_map(lambda v: v[-1], v) for v in
                   (solution.ts, solution.xs, solution.us))  # fmt: skip
        area, regime = self.space.w, np.asarray(self.regimes(t, x))
        total = float(jnp.sum(area))

        def fraction(name: int) -> float:
            return float(np.mean(regime == name))  # all cells have the same area

        return {
            "mean_temperature": float(jnp.sum(area * x)) / total,
            "power": float(jnp.sum(area * u)),
            "heated": fraction(HEATED),
            "regulated": fraction(REGULATED),
            "cooled": fraction(COOLED),
            "decay_rate": float(-self.constants.one_sided),
        }

    def _rate(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return u + self.load(t)

    def _feedback(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return self.gain * (self.reference(t) - x)


def _field(name: str, value: Any, cells: tuple, wrong: Problems) -> jax.Array:
    """Return an array over the cells; add problems to `wrong`."""
    place = f"dvax.models.Thermostat({name})"
    try:
        array = _tree.as_float(value, place)
    except InputError as error:
        wrong += error.problems
        return jnp.zeros(cells)
    fits = jnp.shape(array) in ((), cells)
    if not fits or (_tree.is_concrete(array) and np.any(np.isnan(np.asarray(array)))):
        wrong.add(
            place, _tree.short(array), f"it must be a number, or an array over the cells {cells}",
            "Give one value for each cell",
        )  # fmt: skip
        return jnp.zeros(cells)
    return jnp.broadcast_to(array, cells)


def _signal(name: str, value: Any, cells: tuple) -> AbstractSignal:
    def constant(value: Any) -> jax.Array:
        wrong = Problems()
        field = _field(name, value, cells, wrong)
        if _tree.is_concrete(field) and not np.all(np.isfinite(np.asarray(field))):
            place = f"dvax.models.Thermostat({name})"
            wrong.add(place, _tree.short(field), "it must be finite", "Correct it")
        wrong.raise_any()
        return field

    return as_signal(value, constant)
