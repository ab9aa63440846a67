"""The data of the demonstration, generated once with fixed seeds and shipped beside this file.

**Profile.** A self-affine surface along a line has the power spectral density C(q) ~ q^-(1 + 2H)
with the Hurst exponent H between a longest and a shortest wavelength (Persson, Albohr, Tartaglino,
Volokitin, Tosatti, J. Phys.: Condens. Matter 17 (2005) R1, section 2). Here H = 0.8, the
wavelengths are 5 mm to 20 um on a strip of 20 mm, the root mean square height is 0.8 um about a
mean of 0.8 um, and the phases are random:

    height(s) = mean + sum_k a_k cos(2 pi k s / L + phase_k),  a_k ~ k^-(1/2 + H),  4 <= k <= 1000.

The amplitudes are not random, so mean and root mean square hold exactly, and as the surface is a
formula it is the same surface at every resolution.

**Load.** Filtered noise under an envelope, by the spectral representation (Shinozuka and Deodatis,
Appl. Mech. Rev. 44 (1991) 191): cosines at 0.05 to 10 Hz with random phases, whose spectrum is that
of an oscillator at 0.5 Hz with 60 % damping driven by white noise; the envelope rises over 4 s,
holds until 20 s and decays, as in strong ground motion (Jennings, Housner, Tsai 1968). Its peak is
6 um/s.

Both use Python's own generator, whose sequence of uniform numbers is the same in all versions.
"""

import math
import random
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent
CONFIG, PROFILE, LOAD = "rough_strip.toml", "strip.npy", "load.csv"

POINTS = 20_000
LENGTH = 20.0  # mm
HURST = 0.8
MODES = range(4, 1001)
MEAN_HEIGHT = 0.8  # um
RMS_HEIGHT = 0.8  # um

DURATION = 40.0  # s
RATE = 50  # samples a second
PEAK = 6.0  # um/s
NATURAL_FREQUENCY = 0.5  # Hz
DAMPING = 0.6


def heights(points: int = POINTS) -> np.ndarray:
    """Heights of the surface [um] at the midpoints of `points` equal cells of the strip,
    (points,)."""
    dice = random.Random(19791)
    amplitudes = np.array([k ** -(0.5 + HURST) for k in MODES])
    amplitudes *= RMS_HEIGHT / math.sqrt(0.5 * float(np.sum(amplitudes**2)))
    s = (np.arange(points) + 0.5) / points
    height = np.full(points, MEAN_HEIGHT)
    for k, amplitude in zip(MODES, amplitudes, strict=True):
        height += amplitude * np.cos(2 * math.pi * (k * s + dice.random()))
    return height


def load() -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and load [um/s], each (2001,)."""
    dice = random.Random(19401)
    times = np.arange(int(DURATION * RATE) + 1) / RATE
    noise = np.zeros_like(times)
    for frequency in np.arange(1, 201) * 0.05:
        ratio = frequency / NATURAL_FREQUENCY
        gain = 1 / math.hypot(1 - ratio**2, 2 * DAMPING * ratio)
        # Off the grid of frequencies, so that the sum has no period of 20 s.
        turns = (frequency + 0.0125 * dice.random()) * times + dice.random()
        noise += gain * np.cos(2 * math.pi * turns)
    rise, hold = np.minimum(times / 4, 1) ** 2, np.exp(-np.maximum(times - 20, 0) / 8)
    signal = rise * hold * noise
    return times, PEAK * signal / np.max(np.abs(signal))


def load_text() -> str:
    """The load as a CSV file."""
    rows = [f"{t:.2f},{value:.6f}" for t, value in zip(*load(), strict=True)]
    head = "# Filtered noise under an envelope (generate.py, fixed seed): no measurement."
    return "\n".join([head, "time [s],load [um/s]", *rows]) + "\n"


if __name__ == "__main__":
    np.save(FOLDER / PROFILE, heights(), allow_pickle=False)
    (FOLDER / LOAD).write_text(load_text(), encoding="utf-8")
