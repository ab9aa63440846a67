"""Systems with known properties: half of them violate exactly one assumption, by a margin."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import dvax


class Generated(NamedTuple):
    """A problem, where to look at it, the assumption that it breaks (None: none), and for valid ones
    the moduli as NumPy computes them from the matrices that the problem was made of."""

    problem: dvax.Problem
    x0: Any
    t1: float
    region: dict[str, Any]
    broken: str | None
    truth: dict[str, float]


def generate(seed: int) -> Generated:
    """Number `seed` of the family: even ones are valid."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 4))
    parts = _parts(rng, n, m)
    if seed % 2 == 0:
        valid = (_affine, _smooth, _weighted)[(seed // 2) % 3]
        return valid(rng, n, m, parts)
    broken = BROKEN[(seed // 2) % len(BROKEN)]
    return broken(rng, n, m, parts)


class _Parts(NamedTuple):
    A: Any
    P: Any
    inverse: np.ndarray
    K: Any
    F_x: np.ndarray
    F_u: np.ndarray
    H_x: np.ndarray
    H_u: np.ndarray
    g: np.ndarray


def _parts(rng: Any, n: int, m: int) -> _Parts:
    A = (
        dvax.generators.Scalar(float(rng.normal())),
        dvax.generators.Diagonal(rng.normal(size=n)),
        dvax.generators.Dense(rng.normal(size=(n, n)) - np.eye(n)),
    )[int(rng.integers(3))]
    root = rng.normal(size=(m, m))
    matrix = root @ root.T + 0.5 * np.eye(m)
    scale, entries = float(rng.uniform(0.5, 2.0)), rng.uniform(0.5, 2.0, m)
    P, inverse = (
        (dvax.operators.Scaling(scale), np.eye(m) / scale),
        (dvax.operators.Diagonal(entries), np.diag(1.0 / entries)),
        (dvax.operators.Dense(matrix), np.linalg.inv(matrix)),
    )[int(rng.integers(3))]
    low = -rng.uniform(0.5, 2.0, m)
    speed = float(rng.uniform(0.0, 0.3))
    K = (
        dvax.sets.Box(low, low + 2.0),
        lambda t, args: dvax.sets.Box(low + speed * jnp.sin(t), low + 2.0 + speed * t),
        lambda t, args: dvax.sets.Ball(speed * t * jnp.ones(m), 1.0 + 0.5 * jnp.cos(t)),
        dvax.sets.Ball(0.0, 1.5),
    )[int(rng.integers(4))]
    draw = lambda *shape: 0.5 * rng.normal(size=shape)  # noqa: E731
    # (I − H_u)P⁻¹ has a symmetric part of at least 1/2: H_u = I − (S + skew + I/2)P.
    S, skew = draw(m, m), draw(m, m)
    J = S @ S.T + (skew - skew.T) + 0.5 * np.eye(m)
    H_u = np.eye(m) - J @ np.linalg.inv(inverse)
    return _Parts(A, P, inverse, K, draw(n, n), draw(n, m), draw(m, n), H_u, draw(m))


def _problem(n: int, m: int, parts: _Parts, **other: Any) -> dvax.Problem:
    F_x, F_u, H_x, H_u, g = (jnp.asarray(v) for v in parts[4:])
    given = dict(
        A=parts.A,
        P=parts.P,
        K=parts.K,
        f=lambda t, x, u, args: jnp.cos(t) + F_x @ x + F_u @ u,
        h=lambda t, x, u, args: g * jnp.sin(t) + H_x @ x + H_u @ u,
        state_space=dvax.spaces.Euclidean(n),
        control_space=dvax.spaces.Euclidean(m),
    )
    return dvax.Problem(**{**given, **other})


def _truth(parts: _Parts) -> dict[str, float]:
    frozen = (np.eye(len(parts.g)) - parts.H_u) @ parts.inverse
    norm = lambda v: float(np.linalg.norm(v, 2))  # noqa: E731
    return {
        "alpha_f": norm(parts.F_x), "beta_f": norm(parts.F_u), "alpha_h": norm(parts.H_x),
        "beta_h": norm(parts.H_u), "L_F": norm(frozen),
        "gamma": float(np.linalg.eigvalsh(0.5 * (frozen + frozen.T))[0]),
    }  # fmt: skip


def _affine(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    return Generated(_problem(n, m, parts), jnp.zeros(n), 1.0, {}, None, _truth(parts))


def _smooth(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    """Saturating f, and an h whose slope in u is changed by less than γ allows."""
    F_x, F_u, H_x, H_u, g = (jnp.asarray(v) for v in parts[4:])
    truth = _truth(parts)
    small = 0.3 * truth["gamma"] / np.linalg.norm(parts.inverse, 2)
    problem = _problem(
        n, m, parts,
        f=lambda t, x, u, args: jnp.tanh(F_x @ x) - jnp.abs(F_u @ u) + jnp.cos(t),
        h=lambda t, x, u, args: jnp.sin(H_x @ x) + H_u @ u - small * jnp.sin(u) + g * t,
    )  # fmt: skip
    return Generated(problem, jnp.zeros(n), 1.0, {}, None, {})


def _weighted(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    """F = a(u) G(y) with the drive inside, in a bounded region."""
    H_x, g = jnp.asarray(parts.H_x), jnp.asarray(parts.g)
    G = jnp.asarray((np.eye(m) - parts.H_u) @ parts.inverse)
    problem = _problem(
        n, m, parts,
        h=lambda t, x, u, args: u
        - (1.5 + jnp.sin(jnp.sum(u))) * (G @ parts.P.apply(u) - H_x @ x - g * t),
    )  # fmt: skip
    return Generated(problem, jnp.zeros(n), 1.0, {"x": (-3.0, 3.0)}, None, {})


def _not_monotone(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    """F affine, zero inside K, and not monotone in one direction."""
    J = np.eye(m)
    J[0, 0] = -0.5
    H_u = np.eye(m) - J @ np.linalg.inv(parts.inverse)
    H_x = jnp.asarray(0.2 * np.ones((m, n)))
    problem = _problem(
        n, m, parts, K=dvax.sets.Box(-np.ones(m), np.ones(m)),
        h=lambda t, x, u, args: H_x @ x + jnp.asarray(H_u) @ u,
    )  # fmt: skip
    return Generated(problem, jnp.zeros(n), 1.0, {}, "ass:strong_pseudomono", {})


def _additive_drive(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    """(2 + sin y) y − q: three solutions for some q, where (2 + sin y)(y − q) has one for every q."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 1.5 * np.pi),
        f=lambda t, x, u, args: -u,
        h=lambda t, x, u, args: u - (2.0 + jnp.sin(u)) * u + x,
    )
    return Generated(problem, jnp.zeros(()), 1.0, {}, "ass:strong_pseudomono", {})


def _indifferent(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    """γ = 0: a linear complementarity problem whose matrix is skew."""
    m = max(m, 2)
    parts = _parts(rng, n, m)
    skew = np.triu(np.ones((m, m)), 1)
    skew = jnp.asarray(skew - skew.T)
    P = dvax.operators.Scaling(1.0)
    problem = _problem(
        n, m, parts, P=P, K=dvax.sets.Box(0.0, np.inf),
        h=lambda t, x, u, args: u - skew @ u + 0.1 * jnp.sum(x),
    )  # fmt: skip
    return Generated(problem, jnp.zeros(n), 1.0, {}, "ass:strong_pseudomono", {})


def _jumping_feedback(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    H_u = jnp.asarray(parts.H_u)
    problem = _problem(n, m, parts, h=lambda t, x, u, args: jnp.sign(x[0] - 0.5) + H_u @ u)
    return Generated(problem, jnp.zeros(n), 1.0, {}, "ass:h_lipschitz_x", {})


def _rooted_feedback(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    H_u = jnp.asarray(parts.H_u)
    problem = _problem(n, m, parts, h=lambda t, x, u, args: jnp.sqrt(jnp.abs(x[0])) + H_u @ u)
    return Generated(problem, jnp.ones(n), 1.0, {}, "ass:h_lipschitz_x", {})


def _growing_rate(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    problem = _problem(n, m, parts, f=lambda t, x, u, args: x * jnp.sum(x) + jnp.sum(u))
    return Generated(problem, jnp.zeros(n), 1.0, {}, "ass:f_lipschitz", {})


def _switching_rate(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    problem = _problem(n, m, parts, f=lambda t, x, u, args: jnp.where(u[0] > 0.1, 1.0, -1.0) - x)
    return Generated(problem, jnp.zeros(n), 1.0, {}, "ass:f_lipschitz", {})


def _vanishing_set(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    K = lambda t, args: dvax.sets.Box(2.0 * t * jnp.ones(m), jnp.ones(m))  # noqa: E731
    return Generated(_problem(n, m, parts, K=K), jnp.zeros(n), 1.0, {}, "ass:operators (iii)", {})


def _jumping_set(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    K = lambda t, args: dvax.sets.Box(-jnp.ones(m), jnp.where(t < 0.37, 1.0, 2.0) * jnp.ones(m))  # noqa: E731
    problem = _problem(n, m, parts, K=K)
    return Generated(problem, jnp.zeros(n), 1.0, {}, "ass:time_regularity (i)", {})


def _jumping_data(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    load = dvax.signals.Table([0.0, 0.4, 1.0], [0.0, 1.0, 1.0], kind="constant")
    H_x, H_u = jnp.asarray(parts.H_x), jnp.asarray(parts.H_u)
    problem = _problem(n, m, parts, h=lambda t, x, u, args: load(t) + H_x @ x + H_u @ u)
    return Generated(problem, jnp.zeros(n), 1.0, {}, "ass:time_regularity (ii)", {})


def _infinite_rate(rng: Any, n: int, m: int, parts: _Parts) -> Generated:
    problem = _problem(n, m, parts, f=lambda t, x, u, args: 1.0 / (t - 0.5) - x)
    return Generated(problem, jnp.zeros(n), 1.0, {}, "ass:operators (iv)", {})


BROKEN = [
    _not_monotone, _additive_drive, _indifferent, _jumping_feedback, _rooted_feedback,
    _growing_rate, _switching_rate, _vanishing_set, _jumping_set, _jumping_data, _infinite_rate,
]  # fmt: skip
