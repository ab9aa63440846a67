"""Bounds along `PiecewiseLinear`: proved from the polynomials of its steps, whatever computed them."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from benchmarks.switching import Mode, follow
from tests.selection import mostly_thorough

import dvax
from dvax.evolution.piecewise import radau
from dvax.evolution.piecewise.defect import Norms, Polynomials, step_defect
from dvax.evolution.piecewise.inputs import Piece
from dvax.evolution.piecewise.modes import Equations
from dvax.evolution.piecewise.system import Affine, Sizes


class Random:
    """x' = Ax + By + g·s, w = My + Cx + q·s with s = (1, sin ωt, cos ωt), of which many entries of y
    switch. A stiff one has a small M and B = Cᵀ: a fast mode that decays."""

    def __init__(self, seed, stiff):
        r = np.random.default_rng(seed)
        n, m = int(r.integers(1, 4)), int(r.integers(1, 3))
        self.A = r.normal(size=(n, n)) - 2.0 * np.eye(n)
        S, K = r.normal(size=(2, m, m))
        self.M = 0.3 * S @ S.T + 0.2 * np.eye(m) + 0.5 * (K - K.T)
        self.M = self.M * 10.0 ** -r.uniform(2.0, 5.0) if stiff else self.M
        self.C = r.normal(size=(m, n))
        self.B = self.C.T if stiff else 0.5 * r.normal(size=(n, m))
        self.g, self.q, self.omega = (
            r.normal(size=(n, 3)),
            r.normal(size=(m, 3)),
            r.uniform(0.5, 6.0),
        )
        self.low, self.high = [(0.0, 1.0), (0.0, np.inf), (-1.0, 2.0)][int(r.integers(3))]
        self.x0, self.ts = r.normal(size=n), np.linspace(0.0, r.uniform(1.0, 5.0), 13)[1:]

    def problem(self):
        w = self.omega

        def s(t):
            return jnp.stack([jnp.ones_like(t), jnp.sin(w * t), jnp.cos(w * t)])

        return dvax.Problem(
            A=dvax.generators.Dense(self.A), P=dvax.operators.Scaling(1.0),
            K=dvax.sets.Box(self.low, self.high),
            f=lambda t, x, u, args: self.B @ u + self.g @ s(t),
            h=lambda t, x, u, args: u - (self.M @ u + self.C @ x + self.q @ s(t)),
            control_space=dvax.spaces.Euclidean((len(self.M),)),
        )  # fmt: skip

    def modes(self):
        """z' = Zz and the conditions of every mode, for z = (x, s), in long double."""
        n, m = self.B.shape
        modes = {}
        for key in itertools.product((-1, 0, 1), repeat=m):
            state = np.array(key)
            if np.isinf(self.high) and (state > 0).any():
                continue
            free = state == 0
            Y, R = np.zeros((2, m, n + 3), np.longdouble)
            Y[:, n] = np.where(
                state < 0,
                self.low,
                np.where(state > 0, self.high if np.isfinite(self.high) else 0.0, 0.0),
            )
            R[:, :n], R[:, n:] = self.C, self.q
            M = self.M.astype(np.longdouble)
            if free.any():
                wanted = -(R[free] + M[np.ix_(free, ~free)] @ Y[~free])
                block = M[np.ix_(free, free)]
                inverse = np.linalg.inv(block.astype(float))
                solved = inverse @ wanted
                for _ in range(6):
                    solved = solved + inverse @ (wanted - block @ solved)
                Y[free] = solved
            Z = np.zeros((n + 3, n + 3), np.longdouble)
            Z[:n, :n], Z[:n, n:] = self.A, self.g
            Z[:n] += self.B @ Y
            Z[n + 1, n + 2], Z[n + 2, n + 1] = self.omega, -self.omega
            W, one = M @ Y + R, np.eye(n + 3, dtype=np.longdouble)[n]
            rows = []
            for i, s in enumerate(key):
                if s:
                    rows.append(-s * W[i])
                    continue
                rows.append(Y[i] - self.low * one)
                rows += [] if np.isinf(self.high) else [self.high * one - Y[i]]
            modes[key] = Mode(Z, np.array(rows))
        return modes

    def exact(self):
        """Return x at `ts`, and the number of switchings."""
        sources = [(0.0, np.array([1.0, 0.0, 1.0]))]
        return follow(self.modes(), self.x0, sources, self.ts, fewest=3000)

    def integrated(self):
        """Return x at `ts` by a method of SciPy, which misses no switching for long."""
        modes = {
            key: tuple(np.array(v, float) for v in (mode.Z, mode.conditions))
            for key, mode in self.modes().items()
        }
        n, w = len(self.x0), self.omega

        def rate(t, x):
            z = np.concatenate([x, [1.0, np.sin(w * t), np.cos(w * t)]])
            valid = max(modes, key=lambda key: (modes[key][1] @ z).min())
            return (modes[valid][0] @ z)[:n]

        return scipy.integrate.solve_ivp(
            rate,
            (0.0, self.ts[-1]),
            self.x0,
            "Radau",
            self.ts,
            rtol=1e-10,
            atol=1e-12,
            max_step=2e-3,
        ).y.T


CASES = [(seed, stiff) for seed in range(40) for stiff in (False, True)]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "stiff"), mostly_thorough(CASES, CASES[2:6]))
def test_the_bound_of_random_modes_exceeds_the_error_and_is_of_the_size_of_rounding(seed, stiff):
    case = Random(seed, stiff)
    problem, (exact, count) = case.problem(), case.exact()
    modes = dvax.solve(problem, case.x0, 0.0, case.ts[-1], method=dvax.PiecewiseLinear())
    # The exponentials of stiff modes have roundoff, even in long double.
    tolerance = 2e-12 if stiff else 0.0
    if count != modes.stats["switchings"]:
        # The samples of `follow` have missed a short mode.
        exact, tolerance = case.integrated(), 1e-7 * (1.0 + np.abs(exact).max())
    for method in (dvax.PiecewiseLinear(), None):
        sol = dvax.solve(problem, case.x0, 0.0, case.ts[-1], ts=case.ts, method=method)
        bound = dvax.bound_error(problem, sol)
        error = np.linalg.norm(np.asarray(sol.xs) - exact, axis=1)
        most = np.asarray(bound.x)
        assert bound.status == "proved" and (error <= most + tolerance).all(), (error, most)
        # The trajectory along which it is proved is exact to rounding, which errors multiply.
        assert most[-1] < 1.001 * error[-1] + 1e-6 * (1.0 + np.abs(exact).max())


def decaying(rng, n, m):
    """A system whose modes do not grow: x' = (S − D)x + Cᵀy + g, w = My + Cx + q, with y ≥ −50."""
    S, C = rng.normal(size=(n, n)), rng.normal(size=(m, n))
    A, M = S - S.T - np.diag(rng.uniform(0.0, 2.0, n)), np.diag(rng.uniform(0.1, 2.0, m))
    sizes = Sizes(*(np.abs(v) for v in (A, C.T, M, C)))
    low, high = np.full(m, -50.0), np.full(m, np.inf)
    return Affine(A, C.T, M, C, low, high, np.zeros(m, bool), np.eye(n + m), sizes)


@pytest.mark.parametrize("mistake", [0.0, 1e-9, 1e-3])
@pytest.mark.parametrize("length", [1e-6, 0.3, 2.0])
def test_the_defect_of_a_step_bounds_any_mistake_in_it(mistake, length):
    """Polynomials with a mistake, against the solution of the mode by a matrix exponential."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        n, m = int(rng.integers(1, 4)), int(rng.integers(1, 3))
        system = decaying(rng, n, m)
        state = rng.integers(-1, 1, m)
        equations = Equations(system, tuple(int(s) for s in state), np.ones(n))
        free = state == 0
        inputs = rng.normal(size=n + m)
        piece = Piece(0.0, length, inputs[None], 0.0 * inputs, 0.0 * inputs)
        # y = Rx + r in the mode, and z' = Zz for z = (x, 1).
        M = system.M[np.ix_(free, free)]
        R, r = np.zeros((m, n)), np.where(free, 0.0, system.low)
        R[free] = -np.linalg.solve(M, system.C[free])
        r[free] = -np.linalg.solve(M, inputs[n:][free])
        Z = np.zeros((n + 1, n + 1))
        Z[:n, :n], Z[:n, n] = system.A + system.B @ R, inputs[:n] + system.B @ r
        start = rng.normal(size=n)
        at = lambda t: (scipy.linalg.expm(Z * t) @ np.append(start, 1.0))[:n]  # noqa: B023, E731
        x = np.array([at(length * theta) for theta in radau.NODES])
        y = x[1:] @ R.T + r
        x[1:] += mistake * rng.normal(size=x[1:].shape)
        y = y + mistake * rng.normal(size=y.shape) * free
        used = float(rng.choice([1.0, 0.37]))
        part = Polynomials.of(x, y, (), used, length, piece, 0.0, equations.prescribed_y)
        end = radau.state_at(x, np.array([used]))[0]
        norms = Norms(np.ones(n), np.ones(m))
        found = step_defect(system, equations, norms, part, start, end, np.zeros(n + m))
        error = np.linalg.norm(end - at(used * length))
        assert error <= found.state + 1e-12 * np.linalg.norm(start)
        # A polynomial resolves a short step to rounding.
        assert mistake > 0.0 or length > 1e-3 or found.state < 1e-13 * (1.0 + np.abs(x).max())
        # A point of the step is in its box.
        boxes = part.boxes(np.array([0.0, 0.2, 0.21, 1.0]))
        for theta in (0.0, 0.1, 0.2, 0.205, 0.21, 0.9, 1.0):
            inside = [
                k
                for k, (a, b) in enumerate([(0.0, 0.2), (0.2, 0.21), (0.21, 1.0)])
                if a <= theta <= b
            ]
            value = radau.state_at(x, np.array([theta * used]))[0]
            for k in inside:
                low, high = boxes[k]
                assert (low[:n] <= value + 1e-14 * np.abs(x).max()).all()
                assert (value <= high[:n] + 1e-14 * np.abs(x).max()).all()


@pytest.mark.slow
@pytest.mark.parametrize("rate", mostly_thorough([1e3, 1e6, 1e9], [1e6]))
def test_a_fast_mode_that_decays_leaves_a_small_bound(rate):
    """A capacitor behind a small resistance, which follows a source: x₁' = −rate(x₁ − sin t)."""
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: jnp.stack([-rate * (x[0] - jnp.sin(t)), x[0] - u]),
        h=lambda t, x, u, args: x[1] - u, control_space=dvax.spaces.Euclidean(()),
    )  # fmt: skip
    ts = np.linspace(0.0, 6.0, 13)[1:]
    sol = dvax.solve(problem, jnp.array([0.0, 0.2]), 0.0, 6.0, ts=ts, method=dvax.PiecewiseLinear())
    bound = dvax.bound_error(problem, sol)
    # x₁ in closed form, and x₂ to a tight tolerance.

    def follows(t):
        wave = rate**2 * np.sin(t) - rate * np.cos(t) + rate * np.exp(-rate * t)
        return wave / (1.0 + rate**2)

    exact = scipy.integrate.solve_ivp(
        lambda t, x: follows(t) - np.clip(0.5 * x, 0.0, 1.0), (0.0, 6.0), [0.2], t_eval=ts,
        rtol=1e-13, atol=1e-14, max_step=0.01, method="DOP853",
    ).y[0]  # fmt: skip
    error = np.hypot(np.asarray(sol.xs)[:, 0] - follows(ts), np.asarray(sol.xs)[:, 1] - exact)
    assert bound.status == "proved"
    assert (error <= np.asarray(bound.x) + 2e-12).all() and float(bound.x.max()) < 1e-6
