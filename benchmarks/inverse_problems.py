"""Inverse problems with known answers: a contact field, a rectifier, and a network inside a law."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.fft import dctn, idctn
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares, minimize

import dvax

from .peers import ngspice

Model = Callable[[Any], Any]


class Fit(NamedTuple):
    """Parameters with standard errors, the reduced χ², and numbers of evaluations."""

    found: np.ndarray
    spread: np.ndarray
    chi2: float
    solves: int
    jacobians: int


def fit(
    model: Model,
    data: np.ndarray,
    start: np.ndarray,
    jacobian: Model | None = None,
    relative_step: float | None = None,
) -> Fit:
    """Return the least-squares fit by SciPy's trust-region Gauss–Newton method.

    `model` returns outputs divided by the standard deviation of their noise. Without `jacobian`, J
    is computed by forward differences, with SciPy's step or `relative_step`. The standard errors are
    the square roots of the diagonal of χ²(JᵀJ)⁻¹ with the reduced χ².
    """
    given: Any = "2-point" if jacobian is None else (lambda p: np.asarray(jacobian(p)))
    calls = 0

    def residual(p: np.ndarray) -> np.ndarray:
        nonlocal calls
        calls += 1
        return np.asarray(model(p)) - data

    out = least_squares(
        residual, start, jac=given, x_scale="jac", xtol=1e-10, ftol=1e-10, diff_step=relative_step
    )
    chi2 = 2.0 * out.cost / (data.size - start.size)
    spread = np.sqrt(chi2 * np.diag(np.linalg.inv(out.jac.T @ out.jac)))
    return Fit(out.x, spread, float(chi2), calls, int(out.njev or 0))


# (a) A contact field

FIELD_TRUTH = np.array([2.0, 0.4, 0.8, 0.01])
"""β [MPa/mm], κ₀ [MPa], b_u [1] and the diffusion D [mm²/s] of the contact field."""
FIELD_START = np.array([1.2, 0.55, 0.4, 0.02])
FIELD_NAMES = ("β [MPa/mm]", "κ₀ [MPa]", "b_u [1]", "D [mm²/s]")
FIELD_NOISE = 0.05
_FIELD_TIMES = np.linspace(0.25, 2.0, 8)


def demand(side: int) -> np.ndarray:
    """Return the demand g [mm] at the centres of side² cells of the unit square."""
    s = (np.arange(side) + 0.5) / side
    return 0.6 + 0.5 * np.cos(2 * np.pi * s)[:, None] * np.cos(np.pi * s)


def field_problem(side: int) -> dvax.Problem:
    """x' = DΔx + ℓ(t) − x/2 − u with u ∈ g − x − b_u u − N_[0, κ₀](βu), without flux at the sides."""
    g = jnp.asarray(demand(side))
    return dvax.Problem(
        A=lambda p: dvax.generators.Elliptic(
            (side, side), (1.0, 1.0), boundary="neumann", diffusion=p[3]
        ),
        P=lambda p: dvax.operators.Scaling(p[0]),
        K=lambda t, p: dvax.sets.Box(0.0, p[1]),
        f=lambda t, x, u, p: jnp.sin(3.0 * t) - 0.5 * x - u,
        h=lambda t, x, u, p: g - x - p[2] * u,
    )


def field_model(side: int, adjoint: str = "forward") -> Model:
    """Return x [mm] and the pressure [MPa] at eight times, divided by the noise, as a function of p."""
    problem = field_problem(side)

    def model(p: Any) -> Any:
        sol = dvax.solve(
            problem, jnp.zeros((side, side)), 0.0, 2.0, p, _FIELD_TIMES, dt=0.025,
            method=dvax.ETD2RK(), adjoint=adjoint,
        )  # fmt: skip
        return jnp.concatenate([sol.xs.ravel(), sol.ys.ravel()]) / FIELD_NOISE

    return model


def field_model_scipy(side: int) -> Model:
    """Return the outputs of `field_model` by SciPy's LSODA, with the law solved by hand."""
    g = demand(side)
    k = np.arange(side)
    rate = -((2.0 * side * np.sin(0.5 * np.pi * k / side)) ** 2)
    laplacian = rate[:, None] + rate

    def reaction(x: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.clip((g - x) / (1.0 + p[2]), 0.0, p[1] / p[0])

    def model(p: np.ndarray) -> np.ndarray:
        def right(t: float, x: np.ndarray) -> np.ndarray:
            x = x.reshape(side, side)
            spread = idctn(p[3] * laplacian * dctn(x))
            return np.ravel(spread + np.sin(3.0 * t) - 0.5 * x - reaction(x, p))

        run = solve_ivp(
            right, (0.0, 2.0), np.zeros(side * side), "LSODA", _FIELD_TIMES, rtol=1e-7, atol=1e-9
        )
        xs = run.y.T.reshape(-1, side, side)
        return np.concatenate([xs.ravel(), (p[0] * reaction(xs, p)).ravel()]) / FIELD_NOISE

    return model


def noisy(clean: Any, seed: int) -> np.ndarray:
    """Return outputs with noise of variance one."""
    return np.asarray(clean) + np.random.default_rng(seed).normal(size=np.shape(clean))


# (b) A rectifier

RECTIFIER_TRUTH = np.array([47.0, 1.0, 0.02])
"""The capacity [µF], the load [kΩ] and the resistance of the diode [kΩ]."""
RECTIFIER_START = np.array([30.0, 2.0, 0.05])
RECTIFIER_NAMES = ("C [µF]", "load [kΩ]", "diode [kΩ]")
RECTIFIER_NOISE = np.array([0.05, 2.0])
"""Of the voltage [V] and of the current of the source [mA]."""
RECTIFIER_TIMES = np.linspace(0.0, 60.0, 241)[1:]
_NETLIST = "V1 1 0 SIN(0 10 50)\nD1 1 2\nC1 2 0 47u IC=0\nR1 2 0 1k"


def rectifier_problem() -> dvax.Problem:
    """v' = (i − v/R)/C with 0 ≤ i ⟂ r i + v − e(t) ≥ 0, in V, mA, ms, kΩ and µF; γ = r."""
    return dvax.Problem(
        A=lambda p: dvax.generators.Scalar(-1.0 / (p[0] * p[1])),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, jnp.inf),
        f=lambda t, v, i, p: i / p[0],
        h=lambda t, v, i, p: i - (p[2] * i + v - 10.0 * jnp.sin(0.1 * jnp.pi * t)),
    )


def rectifier_model(p: Any) -> Any:
    """Return the voltage and the current at the times of the record, divided by their noise."""
    sol = dvax.solve(
        rectifier_problem(), 0.0, 0.0, 60.0, p, RECTIFIER_TIMES, dt=0.05,
        method=dvax.ETD2RK(), adjoint="forward",
    )  # fmt: skip
    return jnp.concatenate([sol.xs / RECTIFIER_NOISE[0], sol.us / RECTIFIER_NOISE[1]])


def rectifier_model_scipy(p: np.ndarray) -> np.ndarray:
    """Return the outputs of `rectifier_model` by SciPy's LSODA, with the diode written by hand."""

    def current(t: Any, v: Any) -> Any:
        return np.maximum(0.0, (10.0 * np.sin(0.1 * np.pi * t) - v) / p[2])

    run = solve_ivp(
        lambda t, v: (current(t, v) - v / p[1]) / p[0], (0.0, 60.0), [0.0], "LSODA",
        RECTIFIER_TIMES, rtol=1e-7, atol=1e-9, max_step=1.0,
    )  # fmt: skip
    current_at = current(RECTIFIER_TIMES, run.y[0])
    return np.concatenate([run.y[0] / RECTIFIER_NOISE[0], current_at / RECTIFIER_NOISE[1]])


def rectifier_by_ngspice() -> np.ndarray:
    """Return the outputs of `rectifier_model` at the true parameters, from ngspice."""
    netlist = ngspice.translate(_NETLIST, 1e3 * RECTIFIER_TRUTH[2], 1e-12)
    run = ngspice.simulate(netlist, 0.06, "v(2) i(V1)", longest=1e-5, reltol=1e-5)
    v, i = (np.interp(1e-3 * RECTIFIER_TIMES, run.ts, values) for values in run.values.T)
    return np.concatenate([v / RECTIFIER_NOISE[0], -1e3 * i / RECTIFIER_NOISE[1]])


# (c) A network inside a law

LIPSCHITZ = 0.9
"""The largest product of the norms of the matrices of a limited network."""
UNKNOWN_MODULUS = 0.2
"""γ of the unknown law: 1 − 0.8 max tanh′, since the part that turns the forces is skew-symmetric."""
WIDTH, NOISE, END = 12, 0.05, 6.0
_TIMES = np.linspace(0.0, END, 21)[1:]
_KNOTS = np.linspace(0.0, END, 13)
Weights = tuple[Any, Any, Any]


def wall(phi: Callable[[Any, Any], Any]) -> dvax.Problem:
    """x' = ℓ(t) − x/2 − u with u ∈ x − φ(u) − N_[0,1]²(u)."""
    return dvax.Problem(
        A=dvax.generators.Scalar(-0.5),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: dvax.signals.Table(_KNOTS, args[0])(t) - u,
        h=lambda t, x, u, args: x - phi(args[1], u),
    )


def unknown(theta: Any, u: Any) -> Any:
    return -0.8 * jnp.tanh(u - 0.5) + 0.3 * jnp.stack([u[1], -u[0]])


def network(theta: Weights, u: Any) -> Any:
    W1, b, W2 = theta
    return W2 @ jnp.tanh(W1 @ u + b)


def limited(theta: Weights, limit: Any) -> Weights:
    """Return the weights with ‖W₁‖ ≤ limit and ‖W₂‖ ≤ 0.9 limit."""
    W1, b, W2 = theta
    first, second = (jnp.linalg.norm(W, 2) for W in (W1, W2))
    return (
        W1 / jnp.maximum(1.0, first / limit),
        b,
        W2 / jnp.maximum(1.0, second / (LIPSCHITZ * limit)),
    )


def wall_trajectory(problem: dvax.Problem, load: Any, theta: Any = None) -> Any:
    return dvax.solve(
        problem, jnp.zeros(2), 0.0, END, (load, theta), _TIMES, dt=0.05, method=dvax.ETD2RK()
    ).xs


class Training:
    """Records of the unknown law, and a network's training on them; compiled once for all seeds."""

    def __init__(self) -> None:
        self.model, truth = wall(network), wall(unknown)
        shapes = np.zeros((WIDTH, 2)), np.zeros(WIDTH), np.zeros((2, WIDTH))
        self.unravel = ravel_pytree(shapes)[1]
        self._truth = jax.jit(jax.vmap(lambda load: wall_trajectory(truth, load)))

        def loss(weights: Any, limit: Any, loads: Any, data: Any) -> Any:
            theta = limited(self.unravel(weights), limit)
            xs = jax.vmap(lambda load: wall_trajectory(self.model, load, theta))(loads)
            return jnp.mean((xs - data) ** 2) / NOISE**2

        self.loss = jax.jit(loss)
        self.gradient = jax.jit(jax.value_and_grad(loss))

    def setting(self, seed: int) -> tuple[Any, Any, np.ndarray]:
        """Return two loads, noisy records of the unknown law under them, and initial weights."""
        rng = np.random.default_rng(seed)
        loads = jnp.asarray(rng.uniform(-0.5, 2.0, (2, 13, 2)))
        data = self._truth(loads) + NOISE * rng.normal(size=(2, len(_TIMES), 2))
        scales = np.repeat([0.5, 0.3, 0.3], [2 * WIDTH, WIDTH, 2 * WIDTH])
        return loads, data, scales * rng.normal(size=5 * WIDTH)

    def epoch(
        self, weights: np.ndarray, limit: float, loads: Any, data: Any, *, differences: bool = False
    ) -> Any:
        """Return SciPy's result of twelve iterations of L-BFGS, by derivatives or by differences."""
        if differences:
            fn: Any = lambda w: float(self.loss(w, limit, loads, data))  # noqa: E731
        else:
            fn = lambda w: [np.asarray(v) for v in self.gradient(w, limit, loads, data)]  # noqa: E731
        return minimize(
            fn,
            weights,
            jac=not differences,
            method="L-BFGS-B",
            options={"maxiter": 12, "maxfun": 10**5},
        )

    def weights(self, flat: Any, limit: float) -> Weights:
        return limited(self.unravel(jnp.asarray(flat)), limit)

    def verify(self, theta: Weights, load: Any) -> Any:
        return dvax.verify(self.model, jnp.zeros(2), 0.0, END, (load, theta))


def sampled_modulus(phi: Callable[[Any, Any], Any], theta: Any, points: int = 41) -> float:
    """Return the least eigenvalue of the symmetric part of ∂(u + φ(u)) over a grid, an upper bound of
    γ."""
    one = np.linspace(0.0, 1.0, points)
    grid = np.stack(np.meshgrid(one, one), -1).reshape(-1, 2)
    J = np.asarray(jax.vmap(jax.jacfwd(lambda u: phi(theta, u)))(grid))
    return float(np.linalg.eigvalsh(np.eye(2) + 0.5 * (J + J.transpose(0, 2, 1))).min())
