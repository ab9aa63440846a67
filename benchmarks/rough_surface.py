"""Self-affine surfaces by random phases."""

import numpy as np


def surface(n: int, hurst: float = 0.8, slope: float = 0.1, seed: int = 0) -> np.ndarray:
    """Heights on an n × n grid of the unit cell, with the power spectrum k^{−2(1+H)} from 4 waves a
    cell to n/8, and with that root mean square slope."""
    rows, columns = np.fft.fftfreq(n, 1.0 / n), np.fft.rfftfreq(n, 1.0 / n)
    k = np.hypot(rows[:, None], columns)
    amplitude = np.where((k >= 4) & (k <= n // 8), np.maximum(k, 1.0) ** (-1.0 - hurst), 0.0)
    phases = np.exp(2j * np.pi * np.random.default_rng(seed).random(k.shape))
    heights = np.fft.irfft2(amplitude * phases, (n, n))
    every = np.hypot(rows[:, None], rows)
    square = np.sum(np.abs(np.fft.fft2(heights)) ** 2 * (2 * np.pi * every) ** 2) / n**4
    return heights * slope / np.sqrt(square)
