"""Code in f, h and K that enclosures have to cover: runs succeed, and pulses are not missed."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from tests.selection import mostly_thorough

import dvax

TABLE = jnp.array([1.0, 0.0, 2.0, 1.0, 0.0, 3.0, 1.0, 2.0, 0.0, 1.0, 2.0])
EDGES = jnp.arange(1.0, 10.0)
METHODS = {
    "ETD2RK": None, "ETD4RK": dvax.ETD4RK(), "DormandPrince": dvax.DormandPrince(),
    "ExpRosenbrock": dvax.ExpRosenbrock(),
}  # fmt: skip
WHOLE, TURNS = list(range(1, 11)), [k * np.pi for k in (1, 2, 3)]

CODE = {
    # name: (the drive, the same by NumPy, where it is not smooth)
    "scatter": (lambda t: jnp.zeros(2).at[0].set(jnp.sin(t))[0], np.sin, []),
    "whole part": (lambda t: TABLE[t.astype(int)], lambda t: TABLE[min(int(t), 10)], WHOLE),
    "digitize": (
        lambda t: TABLE[jnp.digitize(t, EDGES)], lambda t: TABLE[np.digitize(t, EDGES)], WHOLE
    ),
    "argmin": (
        lambda t: TABLE[jnp.argmin(jnp.abs(t - jnp.arange(11.0)))],
        lambda t: TABLE[np.argmin(np.abs(t - np.arange(11.0)))], [k + 0.5 for k in range(10)],
    ),
    "tanh": (lambda t: jnp.tanh((t - 5) / 0.05), lambda t: np.tanh((t - 5) / 0.05), [4.5, 5, 5.5]),
    "sigmoid": (
        lambda t: jax.nn.sigmoid((t - 5) / 0.002),
        lambda t: 0.5 + 0.5 * np.tanh((t - 5) / 0.004), [4.97, 5, 5.03],
    ),
    "arctan": (
        lambda t: jnp.arctan((t - 5) / 0.002), lambda t: np.arctan((t - 5) / 0.002),
        [4.9, 4.99, 5, 5.01, 5.1],
    ),
    "power at zero": (
        lambda t: jnp.abs(jnp.sin(t)) ** 1.5, lambda t: np.abs(np.sin(t)) ** 1.5, TURNS
    ),
    "norm at zero": (
        lambda t: jnp.linalg.norm(jnp.stack([jnp.sin(t), jnp.sin(2 * t)])),
        lambda t: np.hypot(np.sin(t), np.sin(2 * t)), TURNS,
    ),
    "sinc": (lambda t: jnp.sinc(t - 5.0), lambda t: np.sinc(t - 5.0), []),
}  # fmt: skip


def by_hand(drive, end, breaks):
    """Solve x' = −x + clip(2 − x, −1, 1) + drive(t) from 0, piece by piece."""
    x, times = np.zeros(1), [0.0, *sorted({float(t) for t in breaks if 0 < t < end}), end]
    for a, b in itertools.pairwise(times):
        rate = lambda t, x: -x + np.clip(2 - x, -1, 1) + float(drive(t))  # noqa: E731
        part = scipy.integrate.solve_ivp(
            rate, (a + 1e-12, b - 1e-12), x, "DOP853", rtol=1e-10, atol=1e-12, max_step=(b - a) / 9
        )
        x = part.y[:, -1]
    return float(x[0])


def driven(drive):
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, args: u + drive(t), h=lambda t, x, u, args: 2.0 - x,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "method"),
    mostly_thorough(
        [(n, m) for n in CODE for m in METHODS],
        [("scatter", "ETD2RK"), ("tanh", "DormandPrince")],
    ),
)  # fmt: skip
def test_solve_handles_common_jax_code_in_f(name, method):
    drive, plain, breaks = CODE[name]
    sol = dvax.solve(driven(drive), 0.0, 0.0, 9.7, method=METHODS[method], max_steps=200_000)
    assert abs(float(sol.xs[-1]) - by_hand(plain, 9.7, breaks)) <= 1e-6


PULSES = {
    # A pulse after, beside or below something larger: the drive, and where it is not smooth.
    "after a start-up": lambda lib, t: lib.where(t**2 < 1.0, 30.0, 1.0) + 0.4 * tent(lib, t, 30.0),
    "after a decay": lambda lib, t: 20.0 * lib.exp(-t) + 0.1 * tent(lib, t, 30.0),
    "beside a square wave": lambda lib, t: (
        lib.where(t % 10.0 < 5.0, 1.0, 0.0) + 0.02 * tent(lib, t, 33.4)
    ),
    "beside a maximum": lambda lib, t: (
        lib.max(lib.stack([lib.sin(t), lib.cos(t)])) + tent(lib, t, 33.4)
    ),
    "beside a power": lambda lib, t: (2.0 + lib.sin(t)) ** lib.cos(t) + tent(lib, t, 33.4),
    "within a pad": lambda lib, t: lib.pad(lib.stack([tent(lib, t, 33.4)]), 1)[1],
}


def tent(lib, t, c, w=0.05):
    """Return a tent of height 1 on about [c − w, c + w], by a function that is not affine in t."""
    return lib.maximum(0.0, 1.0 - lib.abs(t**2 - c**2) / (2 * c * w))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "method"),
    mostly_thorough(
        [(n, m) for n in PULSES for m in METHODS],
        [("beside a maximum", "DormandPrince")],
    ),
)
def test_pulse_beside_larger_data_is_not_missed(name, method):
    drive = PULSES[name]
    breaks = [1.0, *range(5, 40, 5), *(np.pi / 4 + np.pi * np.arange(12))]
    breaks += [np.sqrt(c * c + s * 2 * c * 0.05) for c in (30.0, 33.4) for s in (-1, 0, 1)]
    sol = dvax.solve(
        driven(lambda t: drive(jnp, t)), 0.0, 0.0, 36.0, method=METHODS[method], rtol=1e-5,
        atol=1e-8,
    )  # fmt: skip
    truth = by_hand(lambda t: drive(np, t), 36.0, breaks)
    assert abs(float(sol.xs[-1]) - truth) <= 1e-4


@pytest.mark.thorough
def test_pulse_with_a_factor_that_is_zero_at_a_sample_is_not_missed():
    c, w, d = 59.3, 0.15, 13.8
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        state_space=dvax.spaces.Euclidean(2), control_space=dvax.spaces.Euclidean(()),
        h=lambda t, x, u, args: 2.0 - x[0],
        f=lambda t, x, u, args: jnp.stack(
            [0.1 * u - 0.05 * x[0] + d * x[1] * tent(jnp, t, c, w), jnp.where(t < 58.9, 0.0, 1.0)]
        ),
    )  # fmt: skip
    sol = dvax.solve(problem, jnp.zeros(2), 0.0, 100.0, rtol=1e-4, method=dvax.ExpRosenbrock())
    rate = lambda t, x: [  # noqa: E731
        0.1 * np.clip(2 - x[0], -1, 1) - 0.05 * x[0] + d * x[1] * tent(np, t, c, w),
        float(t > 58.9),
    ]
    x = np.zeros(2)
    times = [0.0, 58.9, *(np.sqrt(c * c + s * 2 * c * w) for s in (-1, 0, 1)), 100.0]
    for a, b in itertools.pairwise(times):
        x = scipy.integrate.solve_ivp(rate, (a, b), x, "DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    assert np.abs(np.asarray(sol.xs[-1]) - x).max() <= 10 * 1e-4 * np.abs(x).max()
