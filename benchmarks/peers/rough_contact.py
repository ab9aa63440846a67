"""Pressures of rough contact as the field computes them: constrained conjugate gradients, non-negative
least squares, and the library Tamaas.

Every function gets the heights r over an n × n unit cell, E* = 1, and solves p ≥ 0, P⁻¹p ≥ δ + r with
equality where p > 0, for a P that multiplies a wave of the number k by k/2, and a constant by `base`.
"""

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.fft
import scipy.linalg
import scipy.optimize


def compliance(n: int, base: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return P⁻¹, by Fourier transforms on all cores."""
    k = 2 * np.pi * np.hypot(np.fft.fftfreq(n, 1.0 / n)[:, None], np.fft.rfftfreq(n, 1.0 / n))
    factor = np.where(k > 0, 2.0 / np.where(k > 0, k, 1.0), 1.0 / base)
    return lambda p: scipy.fft.irfft2(scipy.fft.rfft2(p, workers=-1) * factor, p.shape, workers=-1)


def constrained_cg(
    heights: np.ndarray, approach: float, base: float, tol: float, most: int = 20_000
) -> np.ndarray:
    """The method of Polonsky and Keer 1999, Wear 231, 206–219, for a given approach, which is the
    constrained method of Bemporad and Paggi 2015 (arXiv:1506.00532). It ends when the pressure changes
    by less than `tol` relative to its sum.

    **Raises:** `RuntimeError` if that takes too many iterations.
    """
    apply, drive = compliance(len(heights), base), approach + heights
    p = np.maximum(drive, 0.0)
    direction, previous, keeps = np.zeros_like(p), 1.0, 0.0
    for _ in range(most):
        gap = apply(p) - drive
        touches = p > 0
        square = float(np.sum(gap[touches] ** 2))
        direction = np.where(touches, gap + keeps * square / previous * direction, 0.0)
        image = apply(direction)
        step = np.sum(gap * direction) / np.sum(image * direction)
        new = np.maximum(p - step * direction, 0.0)
        overlaps = (new == 0) & (gap < 0)
        keeps = 0.0 if overlaps.any() else 1.0
        new[overlaps] -= step * gap[overlaps]
        change = np.abs(new - p).sum() / max(new.sum(), 1e-300)
        p, previous = new, square
        if change < tol:
            return p
    raise RuntimeError(f"constrained CG did not converge in {most} iterations")


def nonnegative_least_squares(heights: np.ndarray, approach: float, base: float) -> np.ndarray:
    """min ½⟨p, P⁻¹p⟩ − ⟨δ + r, p⟩ over p ≥ 0 as least squares with the Cholesky factor of P⁻¹, by the
    active-set method of Lawson and Hanson, as Bemporad and Paggi propose."""
    n = len(heights)
    apply, unit = compliance(n, base), np.zeros((n, n))
    unit[0, 0] = 1.0
    kernel = apply(unit)
    index = np.arange(n)
    away = (index[:, None] - index) % n
    matrix = kernel[away[:, None, :, None], away[None, :, None, :]].reshape(n * n, n * n)
    factor = np.linalg.cholesky(matrix)
    right = scipy.linalg.solve_triangular(factor, (approach + heights).ravel(), lower=True)
    return scipy.optimize.nnls(factor.T, right, maxiter=10 * n * n)[0].reshape(n, n)


def has_tamaas() -> bool:
    """Whether the library Tamaas is installed (`pip install tamaas`): Frérot, Anciaux, Rey, Pham-Ba
    and Molinari 2020, J. Open Source Softw. 5, 2121."""
    return importlib.util.find_spec("tamaas") is not None


def tamaas(heights: np.ndarray, mean: float, tol: float) -> Callable[[], np.ndarray]:
    """Return a solve for a mean pressure on a half-space, by the method that its manual recommends."""
    library: Any = importlib.import_module("tamaas")
    library.set_log_level(library.LogLevel.error)

    def solve() -> np.ndarray:
        model = library.ModelFactory.createModel(
            library.model_type.basic_2d, [1.0, 1.0], list(heights.shape)
        )
        model.E, model.nu = 1.0, 0.0
        method = library.PolonskyKeerRey
        solver = method(model, heights, tol, method.pressure, method.pressure)
        solver.max_iter = 100_000
        solver.solve(mean)
        return np.array(model.traction)

    return solve
