"""Solutions without dvax and without JAX, for comparison."""

from decimal import Decimal, localcontext
from itertools import product
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]


def phi(k: int, z: float) -> float:
    """φₖ(z) = Σⱼ zʲ/(j+k)!, summed in 120 digits, so that no cancellation can matter."""
    with localcontext() as digits:
        digits.prec = 120
        x, total = Decimal(z), Decimal(0)
        term = Decimal(1)
        for j in range(1, k + 1):
            term /= j
        j = 0
        while abs(term) > Decimal(10) ** -60 * max(abs(total), Decimal(10) ** -30):
            total += term
            j += 1
            term *= x / (j + k)
        return float(total)


def affine_box_vi(matrix: Array, q: Array, lower: Array, upper: Array) -> Array:
    """The solution of VI({lower ≤ y ≤ upper}, matrix y + q), by trying every face of the box.

    On a face some entries sit on a bound and the others solve their equations. The face whose
    solution violates no condition by more than rounding is the answer.
    """
    n = len(q)
    best, answer = np.inf, np.full(n, np.nan)
    for face in product((-1, 0, 1), repeat=n):
        held = np.array(face)
        if np.any(np.isinf(lower[held < 0])) or np.any(np.isinf(upper[held > 0])):
            continue
        y = np.where(held < 0, lower, np.where(held > 0, upper, 0.0))
        free = held == 0
        if free.any():
            rest = matrix[np.ix_(free, ~free)] @ y[~free] + q[free]
            try:
                y[free] = np.linalg.solve(matrix[np.ix_(free, free)], -rest)
            except np.linalg.LinAlgError:
                continue
        F = matrix @ y + q
        violations = [
            *np.maximum(lower - y, y - upper)[free],
            *(-F)[held < 0],
            *F[held > 0],
        ]
        worst = max(violations, default=0.0)
        if worst < best:
            best, answer = worst, y
    return answer


def symmetric_extremes(matrix: Array, weights: Array) -> tuple[float, float]:
    """Least and greatest ⟨Av, v⟩/⟨v, v⟩ in the inner product Σ wᵢ aᵢ bᵢ: a generalised
    eigenproblem, solved through a Cholesky factor of the mass matrix."""
    import scipy.linalg

    mass = np.diag(weights)
    form = mass @ matrix
    values = scipy.linalg.eigh(0.5 * (form + form.T), mass, eigvals_only=True)
    return float(values[0]), float(values[-1])
