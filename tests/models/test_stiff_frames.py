"""Frames of almost no viscosity."""

from pathlib import Path

import numpy as np
import pytest
from tests.models.test_frame import GROUND, RECORD, STEP, elastoplastic, exactly
from tests.models.test_stiff import work
from tests.selection import mostly_thorough

import dvax
from dvax.models.frame import Accelerogram, Frame

EL_CENTRO = Path(__file__).parents[3] / "shared" / "data" / "elCentro.at2"


def records():
    rng = np.random.default_rng(1)
    white = np.cumsum(rng.normal(size=300))
    white -= np.linspace(white[0], white[-1], 300)
    yield "waves", RECORD
    yield "pulse", Accelerogram(0.01, 0.5 * np.sin(np.pi * np.minimum(np.arange(300) / 40, 2)))
    yield "walk", Accelerogram(0.02, 0.3 * white / np.abs(white).max())


@pytest.mark.thorough
@pytest.mark.parametrize("name", mostly_thorough(["waves", "pulse", "walk"], ["walk"]))
def test_frame_cost_does_not_grow_for_small_viscosity(name):
    record = dict(records())[name]
    knots = record.samples.shape[0]
    peaks, counts = [], []
    for ratio in (1e-2, 1e-8) if name != "waves" else (1e-2, 1e-4, 1e-8):
        frame = Frame(record=record, period=0.6, damping=0.03, yield_displacement=0.4,
                      viscosity_ratio=ratio)  # fmt: skip
        sol = frame.solve(ts=record.knots())
        assert work(sol) <= knots + 40 * (int(sol.stats["switchings"]) + 1), sol.stats
        peaks.append(float(np.abs(np.asarray(sol.xs)[:, 0]).max()))
        counts.append(work(sol))
    assert counts[-1] < 2 * counts[0] and int(sol.stats["switchings"]) >= 2


@pytest.mark.parametrize("ratio", mostly_thorough([1e-4, 1e-8], [1e-8]))
def test_elastoplastic_distance_bounds_the_difference(ratio):
    T, z, limit = 0.5, 0.05, 0.5
    run, _ = exactly(elastoplastic(T, z, limit), GROUND[:151], step=1.25e-3)
    frame = Frame(record=Accelerogram(STEP, GROUND[:151]), period=T, damping=z,
                  yield_displacement=limit, viscosity_ratio=ratio)  # fmt: skip
    sol = frame.solve()
    bound = np.asarray(frame.elastoplastic_distance(sol))[::8]
    apart = np.abs(np.asarray(sol.xs)[::8, 0] - run.states[:, 0])
    assert len(run.switchings) >= 2 and np.all(apart <= bound + 1e-9)
    # Proportional to η/k; and the frame is no nearer than that.
    assert 1e-3 * ratio < apart.max() and bound.max() < 1e6 * ratio


@pytest.mark.thorough
@pytest.mark.parametrize("ratio", [1e-2, 1e-5, 1e-7, 1e-8])
@pytest.mark.parametrize("strength", [0.125, 0.5])
def test_frame_under_el_centro_at_any_viscosity(ratio, strength):
    if not EL_CENTRO.exists():
        pytest.skip("needs elCentro.at2 of OpenSees's verification examples under ../shared/data")
    record = Accelerogram.from_at2(EL_CENTRO)
    for period in (0.2, 0.5, 2.0):
        frame = Frame(record=record, period=period, damping=0.05, yield_ratio=strength,
                      viscosity_ratio=ratio * period)  # fmt: skip
        sol = frame.solve()
        assert work(sol) <= 2 * record.samples.shape[0] + 60 * int(sol.stats["switchings"])
        bound = dvax.bound_error(frame.problem, sol, frame.constants)
        assert float(np.max(np.asarray(bound.x))) < 1e-3
