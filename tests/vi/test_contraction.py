"""The proven contraction factors hold for strongly pseudomonotone operators that are not monotone: the
distance to the solution before and after one step, as the docstrings write the step."""

import numpy as np
import pytest
from tests.vi.families import COUNT, REACH, WEIGHTS, cases

from dvax.vi import Extragradient, ForwardBackwardForward, Projection


def clipped(z, lower, upper):
    return np.clip(z, lower, upper)


def onto_ball(z, center, radius):
    out = z - center
    length = np.linalg.norm(out, axis=1)
    return center + out * np.minimum(1.0, radius / np.maximum(length, 1e-300))[:, None]


def below_plane(z, normal, offset):
    above = np.maximum(np.sum(normal * z, axis=1) - offset, 0.0)
    return z - normal * (above / np.sum(normal * normal, axis=1))[:, None]


PROJECTIONS = {"box": clipped, "ball": onto_ball, "half-space": below_plane}


def extragradient(F, project, y, lam):
    return project(y - lam * F(project(y - lam * F(y))))


def forward_backward_forward(F, project, y, lam):
    z = project(y - lam * F(y))
    return z - lam * (F(z) - F(y))


def projection(F, project, y, lam):
    return project(y - lam * F(y))


# solver, its step, λ of γ and L
METHODS = {
    "extragradient": (Extragradient(), extragradient, lambda g, L: 0.7 / L),
    "a short extragradient": (Extragradient(step=0.2), extragradient, lambda g, L: 0.2 / L),
    "forward-backward-forward": (
        ForwardBackwardForward(), forward_backward_forward, lambda g, L: 0.7 / L,
    ),
    "projection": (Projection(), projection, lambda g, L: g / L**2),
}  # fmt: skip


def check(name, rounds, seed):
    solver, step, length = METHODS[name]
    rng, least = np.random.default_rng(seed), np.inf
    for kind in PROJECTIONS:
        for weight in WEIGHTS:
            a = WEIGHTS[weight][0]
            for _ in range(rounds):
                data, A, b, gamma, L, truth = cases(kind, rng, weight)

                def F(v, a=a, A=A, b=b):
                    return a(np, v)[:, None] * (np.einsum("kij,kj->ki", A, v) + b)

                def project(z, kind=kind, data=data):
                    return PROJECTIONS[kind](z, *data)

                proved = np.asarray(solver.contraction(gamma, L))
                assert np.all((proved > 0) & (proved < 1))
                away = rng.normal(size=truth.shape) * 10.0 ** rng.uniform(-4, 0, (COUNT, 1))
                y = project(truth + away)
                before = np.linalg.norm(y - truth, axis=1)
                after = step(F, project, y, length(gamma, L)[:, None])
                distance = np.linalg.norm(after - truth, axis=1)
                # L holds within reach; a start that is the solution shows nothing.
                use = (np.linalg.norm(y, axis=1) < REACH / 2) & (before > 1e-6)
                ratio, proved = distance[use] / before[use], proved[use]
                assert use.mean() > 0.3
                assert np.all(ratio <= proved * (1 + 1e-9))
                least = min(least, float(np.min((1 - ratio) / (1 - proved))))
    print(f"{name}: {12 * rounds * COUNT} starts, each gains at least {least:.3f} × what is proved")


@pytest.mark.parametrize("name", METHODS)
def test_contraction_factor_holds_for_nonmonotone_operators(name):
    check(name, 1, seed=17)


@pytest.mark.thorough  # 10⁵ starts a method
@pytest.mark.parametrize("name", METHODS)
def test_contraction_factor_holds_for_many_nonmonotone_operators(name):
    check(name, 17, seed=18)
