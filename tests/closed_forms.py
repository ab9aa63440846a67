"""Systems whose solution is known in closed form: three regimes, a moving box with a full P, a
shrinking ball, a nonmonotone weight. Solutions are NumPy; only the problems are dvax."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from tests.once import once

import dvax

Array = np.ndarray[Any, Any]


class ClosedForm(NamedTuple):
    """A problem with x0, t1, its solution t ↦ (x, u), and its constants."""

    problem: dvax.Problem
    x0: Array
    t1: float
    exact: Callable[[float], tuple[Array, Array]]
    constants: dvax.Constants
    args: Any = None


def c1_solution(t: float, x0: Any = -1.0, ell: Any = 3.0) -> tuple[Any, Any]:
    """The contact law through saturation (u = ½), contact (u = ½ − x) and separation (u = 0).

    Written without a comparison of x0 or ell, so that a complex step through it differentiates it.
    """
    a, b, c = (ell - 0.5) / 1.5, 2 * (ell - 0.5), ell / 1.5
    first = np.log((a - x0) / a) / 1.5  # x = 0, where the capacity is left
    second = first + 2 * np.log(b / (b - 0.5))  # x = ½, where contact is lost
    if t <= np.real(first):
        return a + (x0 - a) * np.exp(-1.5 * t), 0.5
    if t <= np.real(second):
        x = b * (1 - np.exp(-0.5 * (t - first)))
        return x, 0.5 - x
    return c + (0.5 - c) * np.exp(-1.5 * (t - second)), 0.0


C1_KINKS = (float(np.log(1.6) / 1.5), float(np.log(1.6) / 1.5 + 2 * np.log(10 / 9)))


def c1_derivatives() -> tuple[float, float]:
    """dx(2)/dx0 and dx(2)/dℓ of C1 by a complex step, exact to rounding."""
    h = 1e-30
    return (
        float(np.imag(c1_solution(2.0, x0=-1.0 + h * 1j)[0]) / h),
        float(np.imag(c1_solution(2.0, ell=3.0 + h * 1j)[0]) / h),
    )


@once
def c1() -> ClosedForm:
    """Section 7 at one point; args is (ℓ,)."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: args[0] - 0.5 * x - u,
        h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )
    constants = dvax.Constants(
        gamma=2.0, L_F=2.0, alpha_h=2.0, beta_h=1.0, alpha_f=0.5, beta_f=1.0, M=1.0, omega=-1.0,
        m_P=1.0, norm_P_inv=1.0, one_sided=-0.5,
    )  # fmt: skip
    exact = lambda t: tuple(np.asarray(v) for v in c1_solution(t))  # noqa: E731
    return ClosedForm(problem, np.asarray(-1.0), 2.0, exact, constants, (jnp.asarray(3.0),))


P2 = np.array([[2.0, 0.5], [0.5, 1.0]])


def c2_solution(t: float) -> tuple[Array, Array]:
    """y rides the corner (1 + ½ sin t, −1 + ¼ cos 2t), so z = x₁ + i x₂ solves a linear equation
    with forcing c₀ + c₁ sin t + c₂ cos 2t, by variation of constants."""
    inverse = np.linalg.inv(P2)
    parts = inverse @ np.array([[1.0, 0.5, 0.0], [-1.0, 0.0, 0.25]])
    drive = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) - np.diag([1.0, 0.5]) @ parts
    c0, c1, c2 = drive[0] + 1j * drive[1]
    rate = -1.0 - 2.0j

    def particular(s: float) -> complex:
        wave = lambda c, w: c * np.exp(1j * w * s) / (1j * w - rate)  # noqa: E731
        return (
            -c0 / rate
            + wave(c1 / 2j, 1) - wave(c1 / 2j, -1)
            + wave(c2 / 2, 2) + wave(c2 / 2, -2)
        )  # fmt: skip

    z = particular(t) + np.exp(rate * t) * (0.3 - 0.2j - particular(0.0))
    corner = np.array([1 + 0.5 * np.sin(t), -1 + 0.25 * np.cos(2 * t)])
    return np.array([z.real, z.imag]), inverse @ corner


@once
def c2() -> ClosedForm:
    problem = dvax.Problem(
        A=dvax.generators.Dense(jnp.array([[-1.0, 2.0], [-2.0, -1.0]])),
        P=dvax.operators.Dense(P2),
        K=lambda t, args: dvax.sets.Box(
            jnp.stack([jnp.full_like(t, -5.0), -1 + 0.25 * jnp.cos(2 * t)]),
            jnp.stack([1 + 0.5 * jnp.sin(t), jnp.full_like(t, 5.0)]),
        ),
        f=lambda t, x, u, args: jnp.array([1.0, 0.0]) - jnp.array([1.0, 0.5]) * u,
        h=lambda t, x, u, args: 0.2 * x - 0.5 * u + jnp.array([4.0, -4.0]),
    )
    inverse = np.linalg.eigvalsh(np.linalg.inv(P2))
    constants = dvax.Constants(
        gamma=1.5 * inverse[0], L_F=1.5 * inverse[1], alpha_h=0.2, beta_h=0.5, alpha_f=0.0,
        beta_f=1.0, M=1.0, omega=-1.0, m_P=inverse[0], norm_P_inv=inverse[1],
    )  # fmt: skip
    return ClosedForm(problem, np.array([0.3, -0.2]), 4.0, c2_solution, constants)


def c3_solution(t: float) -> tuple[Array, Array]:
    length = (
        (2 - 0.5 * t) * np.exp(-t / 2) if t <= 3 else 0.5 * np.exp(-1.5) * np.exp(-1.5 * (t - 3))
    )
    direction = np.array([np.cos(3 * t), np.sin(3 * t)])
    return length * direction, min(length, 0.5 * np.exp(-t / 2)) * direction


@once
def c3() -> ClosedForm:
    problem = dvax.Problem(
        A=dvax.generators.Dense(jnp.array([[-0.5, -3.0], [3.0, -0.5]])),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Ball(0.0, 0.5 * jnp.exp(-t / 2)),
        f=lambda t, x, u, args: -u,
        h=lambda t, x, u, args: 2.0 * x - u,
    )
    constants = dvax.Constants(
        gamma=2.0, L_F=2.0, alpha_h=2.0, beta_h=1.0, alpha_f=0.0, beta_f=1.0, M=1.0, omega=-0.5,
        m_P=1.0, norm_P_inv=1.0,
    )  # fmt: skip
    return ClosedForm(problem, np.array([2.0, 0.0]), 4.0, c3_solution, constants)


def c4_solution(t: float) -> tuple[Array, Array]:
    rest = 0.5 - 0.3 * np.pi
    leaves = np.log((6 - rest) / (1.5 * np.pi - rest))
    if t <= leaves:
        return np.asarray(rest + (6 - rest) * np.exp(-t)), np.asarray(1.5 * np.pi)
    end = 0.5 / 1.2
    x = np.asarray(end + (1.5 * np.pi - end) * np.exp(-1.2 * (t - leaves)))
    return x, x


@once
def c4() -> ClosedForm:
    """F(y) = (2 + sin y)(y − x): strongly pseudomonotone with γ = 1, not monotone."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 1.5 * jnp.pi),
        f=lambda t, x, u, args: 0.5 - 0.2 * u,
        h=lambda t, x, u, args: u - (2 + jnp.sin(u)) * (u - x),
    )
    # |F'| ≤ |cos y||y − x| + 3 ≤ 9 for y ∈ K and x ∈ [0, 6].
    constants = dvax.Constants(
        gamma=1.0, L_F=9.0, alpha_h=3.0, beta_h=10.0, alpha_f=0.0, beta_f=0.2, M=1.0, omega=-1.0,
        m_P=1.0, norm_P_inv=1.0,
    )  # fmt: skip
    return ClosedForm(problem, np.asarray(6.0), 3.0, c4_solution, constants)


def c7_solution(n: int, t: float) -> tuple[Array, Array]:
    s = (np.arange(n) + 0.5) * np.pi / n
    x = np.exp(-t) * np.sin(s)
    return x, np.clip((1.0 - 1.5 * x) / 1.5, 0.0, 0.4)


@once
def c7(n: int) -> ClosedForm:
    """Heat in a rod with fixed ends and a saturated law at each of n points, x = e^{−t} sin s: u = 0.4
    where s < arcsin(4eᵗ/15), nearer to an end than that, and u = 0 where s > arcsin(2eᵗ/3)."""
    wave = jnp.asarray(np.sin((np.arange(n) + 0.5) * (np.pi / n)))

    def load(t: Any) -> Any:
        x = jnp.exp(-t) * wave
        return 0.2 * x + jnp.clip((1.0 - 1.5 * x) / 1.5, 0.0, 0.4)

    problem = dvax.Problem(
        A=dvax.generators.Elliptic(n, jnp.pi), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.4),
        f=lambda t, x, u, args: load(t) - 0.2 * x - u, h=lambda t, x, u, args: 1.0 - 1.5 * x - 0.5 * u,
        state_space=dvax.spaces.L2(jnp.full(n, jnp.pi / n)),
        control_space=dvax.spaces.L2(jnp.full(n, jnp.pi / n)),
    )  # fmt: skip
    constants = dvax.Constants(
        gamma=1.5, L_F=1.5, alpha_h=1.5, beta_h=0.5, alpha_f=0.2, beta_f=1.0, M=1.0, omega=-1.0,
        m_P=1.0, norm_P_inv=1.0,
    )  # fmt: skip
    return ClosedForm(problem, c7_solution(n, 0.0)[0], 1.0, lambda t: c7_solution(n, t), constants)


ALL: dict[str, Callable[[], ClosedForm]] = {"C1": c1, "C2": c2, "C3": c3, "C4": c4}
