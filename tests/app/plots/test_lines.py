"""Thinned curves keep their extremes, their ends and their gaps."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dvax.app.plots.lines import positive, thin


@given(st.integers(1, 400), st.integers(0, 2**32 - 1))
def test_thinned_curve_keeps_extremes_and_ends(count: int, seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=count)
    kept = thin(np.arange(count), values, most=40)
    assert len(kept) <= 42
    assert {0, count - 1, int(values.argmin()), int(values.argmax())} <= set(kept.tolist())
    assert (np.diff(kept) > 0).all()


def test_thinned_curve_keeps_gaps() -> None:
    values = np.arange(1000.0)
    values[300:600] = np.nan
    kept = thin(np.arange(1000), values, most=40)
    assert np.isnan(values[kept]).any()
    assert np.isfinite(values[kept]).sum() >= 20


def test_logarithmic_curve_has_gaps_at_nonpositive_and_nonfinite_values() -> None:
    given_values = np.array([1.0, 0.0, -1.0, np.inf, np.nan])
    np.testing.assert_array_equal(positive(given_values), [1.0] + 4 * [np.nan])
