"""The files of the demonstration are the output of their script, and show all three regimes."""

import numpy as np
import pytest

from dvax.app.runs.config import build_contact, load_config
from dvax.app.runs.demo import generate


def test_demo_files_are_the_output_of_their_script():
    shipped = np.load(generate.FOLDER / generate.PROFILE, allow_pickle=False)
    np.testing.assert_allclose(shipped, generate.heights(), rtol=0, atol=1e-12)
    rows = (generate.FOLDER / generate.LOAD).read_text().splitlines()
    made = generate.load_text().splitlines()
    assert rows[:2] == made[:2] and len(rows) == len(made)
    a, b = (np.array([[float(c) for c in r.split(",")] for r in t[2:]]) for t in (rows, made))
    # Half a unit in the last written digit may round either way on another machine.
    np.testing.assert_allclose(a, b, rtol=0, atol=1.01e-6)


def test_demo_surface_is_self_affine_with_the_stated_height():
    height = generate.heights()
    assert np.mean(height) == pytest.approx(0.8, abs=1e-12)
    assert np.std(height) == pytest.approx(0.8, abs=1e-12)
    power = np.abs(np.fft.rfft(height - np.mean(height))) ** 2
    k = np.arange(4, 1001)
    slope = np.polyfit(np.log(k), np.log(power[k]), 1)[0]
    assert slope == pytest.approx(-(1 + 2 * 0.8), abs=1e-6)
    assert np.sum(power[k]) == pytest.approx(np.sum(power), rel=1e-12), "band-limited"


def test_demo_surface_is_the_same_at_every_resolution():
    # Midpoints of 20 000 cells are, every third one, midpoints of a third as many cells.
    np.testing.assert_allclose(generate.heights(2001 * 3)[1::3], generate.heights(2001), atol=1e-11)


def test_demo_has_three_regimes_and_satisfies_the_decay_criterion():
    config = load_config(generate.FOLDER / generate.CONFIG)
    m, inputs = config.model, build_contact(config)
    assert inputs.boundary.size == 20_000
    assert m.alpha > m.d_x + m.d_u * m.b_x / (1 + m.b_u)
    # A plain Euler march of the thinned strip, sharing nothing with the solvers.
    thin = slice(None, None, 50)
    record = inputs.load.series
    assert record is not None and inputs.demand.profile is not None
    height, s = inputs.demand.profile.values[thin], inputs.boundary.coordinates[0][thin]
    x, seen = np.zeros_like(height), np.zeros((3, height.size))
    for t, load in zip(record.times, record.values, strict=True):
        drive = height * (1 - 0.4 * np.exp(-t / 4)) - m.b_x * x
        pressure = np.clip(m.beta / (1 + m.b_u) * drive, 0, m.kappa0)
        seen += [pressure == 0, (pressure > 0) & (pressure < m.kappa0), pressure == m.kappa0]
        load = load * (1 + 0.3 * np.cos(np.pi * s / 20))
        x += 0.02 * (load - (m.alpha + m.d_x) * x - m.d_u * pressure / m.beta)
    share = seen.mean(axis=1) / record.times.size
    assert np.all(share > 0.1), f"unloaded, active, saturated: {share}"
    assert np.mean(np.all(seen > 0, axis=0)) > 0.5, "most points pass through all three"
