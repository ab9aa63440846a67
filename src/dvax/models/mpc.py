"""Model predictive control: feedback by a quadratic programme that is solved at every time."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from ..errors import InputError, Problems, input_error
from ..generators import Dense
from ..operators import Scaling
from ..problem import Problem
from ..sets import AbstractSet, Box, Polyhedron
from ..signals import AbstractSignal, as_signal
from ..spaces import Euclidean
from ..theory import Constants
from ._horizon import Horizon, condense, gain_by_regions

MAX_REGIONS = 2**14
"""Largest number of sets of inactive inputs that `lipschitz` enumerates."""


class Lipschitz(NamedTuple):
    """Proved bounds on |Δu₀|/|Δx| of a controller, in order of increasing sharpness.

    `theory`: L = α_h‖P⁻¹‖/γ; `projection`: from the projection in the norm of H; `regions`: the maximum
    over all sets of inactive inputs, or None if there are more than 2¹⁴ or slew limits.
    """

    theory: float
    projection: float
    regions: float | None


class LinearMPC(eqx.Module):
    """Continuous-time model predictive control of a linear plant with input limits.

        x' = A x + B u₀ + w(t)
        U = (u₀, …, u_{N−1}) ∈ K,   0 ∈ H U + G x − r(t) + N_K(U)

    U minimises ½UᵀHU + (Gx − r)ᵀU over K, which is half of the cost

        Σ_{k<N} (xₖ − x_s)ᵀQ(xₖ − x_s) + (uₖ − u_s)ᵀR(uₖ − u_s) + (x_N − x_s)ᵀΠ(x_N − x_s)

    of the predicted states x₀ = x, xₖ₊₁ = A_δxₖ + B_δuₖ (the plant with inputs constant over δ), up to
    terms independent of U. Π solves the Riccati equation of the infinite horizon, so without active
    limits u₀ = u_s − K(x − x_s) is the linear-quadratic regulator. The set K is `lower` ≤ uₖ ≤ `upper`,
    with `slew` also |uₖ₊₁ − uₖ| ≤ slew.

    In the problem A is the matrix of the plant, f = B u₀ + w, P = I and h = U − HU − Gx + r. H ≻ 0, so
    F(y) = Hy + Gx − r is strongly monotone with γ = λ_min(H). State constraints would make K depend on
    x, which the theory does not cover.

    **Arguments:** `A` (n, n) in 1/time and `B` (n, m); `Q` ⪰ 0 and `R` ≻ 0, the weights of a predicted
    step; `horizon` N; `step` δ, in time; `lower` < `upper` and `slew` > 0, numbers or vectors of m;
    `target` x_s and `feed` u_s (default 0), `disturbance` w: vectors, `dvax.signals` or callables of
    t. The matrices must not be traced: the constructor solves the Riccati equation.

    **Raises:** `dvax.InputError` with all invalid arguments, and if (A, B) is not stabilisable or
    unstable modes are not observable through Q.

    Source: Bemporad, Morari, Dua and Pistikopoulos 2002, Automatica 38, 3–20 (condensing; the law is
    affine in pieces).

    ```python
    >>> import jax.numpy as jnp
    >>> from dvax.models.mpc import LinearMPC
    >>> mpc = LinearMPC(A=[[0.0, 1.0], [-1.0, -0.2]], B=[[0.0], [1.0]], Q=[[1.0, 0.0], [0.0, 1.0]],
    ...                 R=[[0.1]], horizon=8, step=0.25, lower=-0.5, upper=0.5)
    >>> u0 = lambda *x: float(mpc.move(0.0, jnp.array(x))[0])
    >>> round(u0(0.1, 0.1) + float(mpc.regulator[0] @ jnp.array([0.1, 0.1])), 12), u0(2.0, 2.0)
    (0.0, -0.5)

    ```
    """

    A: jax.Array
    B: jax.Array
    H: jax.Array
    G: jax.Array
    terminal: jax.Array
    regulator: jax.Array
    lower: jax.Array
    upper: jax.Array
    slew: jax.Array | None
    target: AbstractSignal
    feed: AbstractSignal
    disturbance: AbstractSignal
    horizon: int = eqx.field(static=True)

    def __init__(
        self,
        *,
        A: Any,
        B: Any,
        Q: Any,
        R: Any,
        horizon: Any,
        step: Any,
        lower: Any,
        upper: Any,
        slew: Any = None,
        target: Any = None,
        feed: Any = None,
        disturbance: Any = None,
    ):
        parts = Horizon.checked(A=A, B=B, Q=Q, R=R, horizon=horizon, step=step)
        n, m = parts.B.shape
        wrong = Problems()
        limits: dict[str, Any] = {"lower": lower, "upper": upper}
        if slew is not None:
            limits["slew"] = slew
        arrays = {name: _vector(name, value, m, wrong) for name, value in limits.items()}
        if not wrong and np.any(arrays["lower"] >= arrays["upper"]):
            wrong.add(
                "dvax.models.LinearMPC(lower, upper)", f"{lower} and {upper}",
                "lower < upper must hold for every input", "Swap or widen the bounds",
            )  # fmt: skip
        if slew is not None and not wrong and np.any(arrays["slew"] <= 0):
            wrong.add(
                "dvax.models.LinearMPC(slew)", f"{slew}", "it must be positive",
                "Omit it if there is no slew limit",
            )  # fmt: skip
        signals = {"target": (target, n), "feed": (feed, m), "disturbance": (disturbance, n)}
        for name, (value, size) in signals.items():
            with wrong.collect():
                setattr(self, name, _signal(value, size, f"dvax.models.LinearMPC({name})"))
        wrong.raise_any()
        qp = condense(parts)
        eigenvalues = np.linalg.eigvalsh(qp.H)
        if eigenvalues[0] <= len(eigenvalues) * np.finfo(float).eps * eigenvalues[-1]:
            raise input_error(
                "dvax.models.LinearMPC(horizon, step)",
                f"growing predictions with λ_max(H) = {eigenvalues[-1]:.1e}",
                "λ_min(H) ≥ λ_min(R) > 0, which makes the law strongly monotone, must be above the "
                "roundoff of λ_max(H)",
                "Shorten the horizon, or stabilise the plant first",
            )
        self.A, self.B = jnp.asarray(parts.A), jnp.asarray(parts.B)
        self.H, self.G = jnp.asarray(qp.H), jnp.asarray(qp.G)
        self.terminal, self.regulator = jnp.asarray(qp.terminal), jnp.asarray(qp.regulator)
        self.lower, self.upper = jnp.asarray(arrays["lower"]), jnp.asarray(arrays["upper"])
        self.slew = jnp.asarray(arrays["slew"]) if slew is not None else None
        self.horizon = parts.horizon

    @property
    def fit(self) -> str:
        """How the model relates to the class of the theory."""
        return "exact"

    @property
    def inputs(self) -> int:
        """m, the number of inputs of the plant."""
        return self.B.shape[1]

    @property
    def problem(self) -> Problem:
        """The closed loop, with a state of n entries and a control of Nm entries."""
        return Problem(
            A=Dense(self.A),
            P=Scaling(1.0),
            K=self.moves,
            f=self._rate,
            h=self._feedback,
            state_space=Euclidean(self.A.shape[:1]),
            control_space=Euclidean(self.H.shape[:1]),
        )

    @property
    def moves(self) -> AbstractSet:
        """The set K of input sequences that satisfy the limits."""
        low, up = (jnp.tile(v, self.horizon) for v in (self.lower, self.upper))
        if self.slew is None:
            return Box(low, up)
        m, size = self.inputs, self.H.shape[0]
        change = np.eye(size - m, size, m) - np.eye(size - m, size)
        rows = jnp.asarray(np.concatenate([np.eye(size), -np.eye(size), change, -change]))
        slew = jnp.tile(self.slew, self.horizon - 1)
        return Polyhedron(rows, jnp.concatenate([up, -low, slew, slew]))

    @property
    def constants(self) -> Constants:
        """The proved constants.

        γ = λ_min(H), L_F = λ_max(H), α_h = ‖G‖, β_h = ‖I − H‖, β_f = ‖B‖, and ω is the logarithmic norm
        of A. `dvax.verify(mpc.problem, energy=True)` adds a decay rate in an adapted norm."""
        A, B, H, G = _tree.host((self.A, self.B, self.H, self.G))
        lib = _tree.array_module(A, B, H, G)
        eigenvalues = lib.linalg.eigvalsh(H)
        growth = Dense(self.A).growth(Euclidean(A.shape[:1]))
        return Constants(
            gamma=eigenvalues[0],
            L_F=eigenvalues[-1],
            alpha_h=lib.linalg.norm(G, 2),
            beta_h=lib.max(lib.abs(1.0 - eigenvalues)),
            alpha_f=0.0,
            beta_f=lib.linalg.norm(B, 2),
            M=growth.M,
            omega=growth.omega,
            m_P=1.0,
            norm_P_inv=1.0,
            status="proved",
        )

    @property
    def lipschitz(self) -> Lipschitz:
        """Lipschitz bounds of the input u₀ as a function of the state.

        In ⟨·,·⟩_H the solution U is the projection of −H⁻¹(Gx − r) onto K, which is nonexpansive:
        ‖ΔU‖_H ≤ ‖H^{−1/2}GΔx‖. Hence |Δu₀| ≤ ‖E₁H^{−1/2}‖‖H^{−1/2}G‖|Δx|, while the bound of the theory
        is ‖H⁻¹‖‖G‖. On a box the law is continuous, and affine for each fixed set I of inactive inputs
        with the slope −E₁(H_II)⁻¹G_I. The largest of these slopes is therefore a bound.
        """
        H, G = np.asarray(self.H), np.asarray(self.G)
        m, size = self.inputs, len(H)
        c = self.constants
        first = np.linalg.inv(H)[:m, :m]
        across = G.T @ np.linalg.solve(H, G)
        projection = np.sqrt(np.linalg.norm(first, 2) * np.linalg.norm(across, 2))
        enumerable = self.slew is None and 2**size <= MAX_REGIONS
        regions = gain_by_regions(H, G, m) if enumerable else None
        return Lipschitz(float(c.L), float(projection), regions)

    def plan(self, t: Any, x: Any) -> jax.Array:
        """Return U, shape (N, m), the optimal inputs over the horizon at the state x."""
        return self.problem.response(t, x).reshape(self.horizon, self.inputs)

    def move(self, t: Any, x: Any) -> jax.Array:
        """Return u₀, the input of the plant."""
        return self.plan(t, x)[0]

    def figures(self, solution: Any, decay: Any = None) -> dict[str, Any]:
        """Return the results of a solution.

        `final_state`; `peak_input`, the largest |u₀| at the saved times; `held`, the fraction of these
        times with an input at a limit; `lipschitz`, the sharpest available bound. If `decay`, the
        `dvax.Constants` of `dvax.verify(mpc.problem, energy=True)`, is given: `decay_rate` and
        `overshoot`."""
        m = self.inputs
        first = np.asarray(solution.us)[:, :m]
        active = (first <= np.asarray(self.lower)) | (first >= np.asarray(self.upper))
        bounds = [bound for bound in self.lipschitz if bound is not None]
        figures: dict[str, Any] = {
            "final_state": [float(v) for v in solution.xs[-1]],
            "peak_input": float(np.max(np.abs(first))),
            "held": float(np.mean(np.any(active, axis=1))),
            "lipschitz": min(bounds),
        }
        if decay is not None and decay.energy is not None:
            overshoot, rate = decay.energy
            figures |= {"decay_rate": -float(rate), "overshoot": float(overshoot)}
        return figures

    def _rate(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return self.B @ u[: self.inputs] + self.disturbance(t)

    def _feedback(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        # r = H(u_s, …, u_s) + G x_s, since the cost is quadratic in x − x_s and u − u_s.
        shift = self.H @ (jnp.tile(self.feed(t), self.horizon) - u)
        return u + shift - self.G @ (x - self.target(t))


def _vector(name: str, value: Any, size: int, wrong: Problems) -> np.ndarray:
    """Return an array with one number for each input; add problems to `wrong`."""
    place = f"dvax.models.LinearMPC({name})"
    try:
        given = np.asarray(_tree.as_float(value, place))
    except InputError as error:
        wrong += error.problems
        return np.zeros(size)
    if given.shape not in ((), (size,)) or not np.all(np.isfinite(given)):
        wrong.add(
            place, _tree.short(given), f"it must be a finite number, or {size}, one for each input",
            "Correct the value",
        )  # fmt: skip
        return np.zeros(size)
    return np.broadcast_to(given, (size,))


def _signal(value: Any, size: int, name: str) -> AbstractSignal:
    def constant(value: Any) -> jax.Array:
        given = jnp.zeros(size) if value is None else _tree.as_float(value, name)
        if jnp.shape(given) != (size,):
            raise input_error(
                name, f"shape {jnp.shape(given)}", f"it must be a vector of {size} entries",
                "Give one number for each entry",
            )  # fmt: skip
        return given

    return as_signal(value, constant)
