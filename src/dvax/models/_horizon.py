"""The condensed quadratic programme of a linear plant and a quadratic cost over a horizon."""

import itertools
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from .. import _tree
from ..errors import InputError, InputProblem, Problems, input_error
from ._numbers import positive


class Condensed(NamedTuple):
    """½UᵀHU + (Gx)ᵀU, half of the cost of the inputs U from the state x.

    `terminal` is the terminal weight Π. `regulator` is the gain of the linear-quadratic regulator,
    which gives the first input if no limit is active.
    """

    H: np.ndarray
    G: np.ndarray
    terminal: np.ndarray
    regulator: np.ndarray


class Horizon(NamedTuple):
    """A plant (A, B), the weights (Q, R) of a step, the number of steps and their length."""

    A: np.ndarray
    B: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    horizon: int
    step: float

    @classmethod
    def checked(cls, *, A: Any, B: Any, Q: Any, R: Any, horizon: Any, step: Any) -> "Horizon":
        """Return the checked data, or raise an `InputError` with all problems."""
        wrong = Problems()
        a, b, q, r = (_matrix(name, v, wrong) for name, v in zip("ABQR", (A, B, Q, R)))
        if not (isinstance(horizon, int) and not isinstance(horizon, bool) and horizon > 0):
            wrong.add(
                "dvax.models.LinearMPC(horizon)", repr(horizon),
                "it must be a positive integer, the number of inputs in the horizon",
                "Give a number such as 10 or 20",
            )  # fmt: skip
        why = "each input is constant over this time"
        length = positive("dvax.models.LinearMPC(step)", step, wrong, why=why)
        if not wrong:
            wrong += _matrix_problems(a, b, q, r)
        wrong.raise_any()
        return cls(a, b, q, r, horizon, float(length))


def condense(given: Horizon) -> Condensed:
    """Return H = R̄ + ΓᵀQ̄Γ and G = ΓᵀQ̄Φ, where the predicted states are Φx + ΓU.

    **Raises:** `dvax.InputError` if the Riccati equation has no stabilising solution.
    """
    A, B, Q, R, N, step = given
    n, m = B.shape
    propagator = scipy.linalg.expm(step * np.block([[A, B], [np.zeros((m, n + m))]]))
    A_step, B_step = propagator[:n, :n], propagator[:n, n:]
    terminal = _riccati(A_step, B_step, Q, R)
    regulator = np.linalg.solve(R + B_step.T @ terminal @ B_step, B_step.T @ terminal @ A_step)
    # Row block k is the state after k + 1 steps.
    powers = [np.eye(n)]
    for _ in range(N):
        powers.append(A_step @ powers[-1])
    Phi = np.concatenate(powers[1:])
    zero = np.zeros((n, m))
    Gamma = np.block(
        [[powers[k - j] @ B_step if j <= k else zero for j in range(N)] for k in range(N)]
    )
    weights = scipy.linalg.block_diag(*[Q] * (N - 1), terminal)
    H = scipy.linalg.block_diag(*[R] * N) + Gamma.T @ weights @ Gamma
    return Condensed(0.5 * (H + H.T), Gamma.T @ weights @ Phi, terminal, regulator)


def gain_by_regions(H: np.ndarray, G: np.ndarray, m: int) -> float:
    """Return the maximum of ‖E₁(H_II)⁻¹G_I‖ over all sets I of inactive inputs."""
    size, best = len(H), 0.0
    for count in range(1, size + 1):
        sets = np.array(list(itertools.combinations(range(size), count)))
        # Only sets with an inactive input in the first step contribute.
        sets = sets[sets[:, 0] < m]
        if not len(sets):
            continue
        slopes = np.linalg.solve(H[sets[:, :, None], sets[:, None, :]], G[sets])
        first = np.where((sets < m)[:, :, None], slopes, 0.0)[:, : min(m, count)]
        best = max(best, float(np.max(np.linalg.norm(first, 2, axis=(1, 2)))))
    return best


def _riccati(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    try:
        return scipy.linalg.solve_discrete_are(A, B, Q, R)
    except np.linalg.LinAlgError as error:
        raise input_error(
            "dvax.models.LinearMPC(A, B, Q)",
            f"a Riccati equation without a stabilising solution ({error})",
            "every mode that does not decay must be controllable by B and observable through Q",
            "Add an actuator, or give the mode a weight in Q",
        ) from error


def _matrix(name: str, value: Any, wrong: Problems) -> np.ndarray:
    place = f"dvax.models.LinearMPC({name})"
    try:
        array = _tree.as_float(value, place)
    except InputError as error:
        wrong += error.problems
        return np.zeros((0, 0))
    concrete = _tree.is_concrete(array)
    if not concrete or np.ndim(array) != 2 or not np.all(np.isfinite(array)):
        wrong.add(
            place, _tree.short(array) if concrete else "a traced array",
            "it must be a matrix of finite numbers that are not traced",
            "Give rows of numbers",
        )  # fmt: skip
        return np.zeros((0, 0))
    return np.asarray(array)


def _matrix_problems(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray
) -> list[InputProblem]:
    n, m = len(A), B.shape[1]
    rules = [
        ("A", A, A.shape == (n, n) and n > 0, "it must be square"),
        ("B", B, B.shape == (n, m) and m > 0, f"it must have a row for each of the {n} states"),
        ("Q", Q, _is_definite(Q, n, -1e-12), f"it must be symmetric and ⪰ 0, {n} by {n}"),
        (
            "R",
            R,
            _is_definite(R, m, 0.0),
            f"it must be symmetric and ≻ 0, {m} by {m}, so that γ > 0",
        ),
    ]
    return [
        InputProblem(
            f"dvax.models.LinearMPC({name})", _tree.short(value), rule, "Correct the matrix"
        )
        for name, value, holds, rule in rules
        if not holds
    ]


def _is_definite(W: np.ndarray, size: int, least: float) -> bool:
    if W.shape != (size, size) or not np.allclose(W, W.T, rtol=1e-12, atol=0.0):
        return False
    return bool(np.linalg.eigvalsh(W)[0] > least * np.abs(W).max())
