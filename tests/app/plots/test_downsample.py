"""Downsampling in one pass agrees with a direct computation on the whole arrays."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from tests.app.plots.synthetic import Recipe, write_run

from dvax.app.plots import downsample as module
from dvax.app.plots.downsample import downsample, edges
from dvax.app.plots.run_reader import read_run
from dvax.errors import InputError


@pytest.fixture
def small_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few cells and one-frame blocks, so that small runs are reduced and read in many parts."""
    monkeypatch.setattr(module, "SPACE_CELLS", 7)
    monkeypatch.setattr(module, "TIME_CELLS", 5)
    monkeypatch.setattr(module, "BLOCK_BYTES", 1)


def whole(run_dir: Path) -> xr.Dataset:
    return xr.open_zarr(run_dir / "trajectory.zarr", consolidated=False, chunks=None).load()


def test_regime_shares_are_the_weighted_measure_of_each_regime(
    tmp_path: Path, small_cells: None
) -> None:
    run_dir = write_run(tmp_path / "run", Recipe(points=(31,), frames=12))
    data, found = whole(run_dir), downsample(read_run(run_dir))
    weight = data.weight.values / data.weight.values.sum()
    for kind in range(3):
        direct = ((data.regime.values == kind) * weight).sum(axis=1)
        np.testing.assert_allclose(found.shares[kind], direct, atol=1e-14)
    np.testing.assert_allclose(found.shares.sum(axis=0), 1.0, atol=1e-14)
    assert found.shares.max(axis=1).min() > 0, "every regime must occur, or the test sees nothing"


def test_downsampled_cells_hold_the_mean_and_the_common_regime_of_their_block(
    tmp_path: Path, small_cells: None
) -> None:
    run_dir = write_run(tmp_path / "run", Recipe(points=(31,), frames=12))
    data, cells = whole(run_dir), downsample(read_run(run_dir)).cells
    assert cells is not None and cells.reduced
    assert cells.mean.shape == (5, 7)
    frames, points = np.arange(5) * 12 // 5, np.arange(7) * 31 // 7
    for i, (t0, t1) in enumerate(zip(frames, [*frames[1:], 12], strict=True)):
        for j, (p0, p1) in enumerate(zip(points, [*points[1:], 31], strict=True)):
            pressure = data.pressure.values[t0:t1, p0:p1]
            regime = data.regime.values[t0:t1, p0:p1]
            np.testing.assert_allclose(cells.mean[i, j], pressure.mean(), rtol=1e-12)
            assert cells.common[i, j] == np.bincount(regime.ravel(), minlength=3).argmax()


def test_highest_pressure_is_that_of_one_point(tmp_path: Path, small_cells: None) -> None:
    run_dir = write_run(tmp_path / "run", Recipe(points=(31,), frames=12))
    data = whole(run_dir)
    data.pressure.values[5, 17] = 99.0
    data.drop_encoding().to_zarr(run_dir / "trajectory.zarr", mode="w", consolidated=False)
    found = downsample(read_run(run_dir))
    assert found.cells is not None
    assert found.pressure_high == 99.0
    assert found.cells.mean.max() < 99.0


def test_unknown_regime_is_reported_with_its_place(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", Recipe(points=(31,), frames=12))
    data = whole(run_dir)
    data.regime.values[3, 4] = 7
    data.drop_encoding().to_zarr(run_dir / "trajectory.zarr", mode="w", consolidated=False)
    with pytest.raises(InputError, match=r"regime\[3, 4\]: got 7"):
        downsample(read_run(run_dir))


def test_cell_edges_lie_half_way_between_centres() -> None:
    np.testing.assert_allclose(edges(np.array([0.0, 1.0, 3.0])), [-0.5, 0.5, 2.0, 4.0])
    np.testing.assert_allclose(edges(np.array([2.0])), [1.0, 3.0])


@pytest.mark.parametrize(("chunk", "sizes"), [(3, {3}), (4, {4}), (12, {1})])
def test_blocks_are_whole_chunks_up_to_a_size_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int, sizes: set[int]
) -> None:
    run_dir = write_run(tmp_path / "run", Recipe(points=(31,), frames=12))
    data = whole(run_dir).drop_encoding()
    encoding = {name: {"chunks": (chunk, 31)} for name in ("pressure", "indentation", "regime")}
    data.to_zarr(run_dir / "trajectory.zarr", mode="w", consolidated=False, encoding=encoding)
    monkeypatch.setattr(module, "BLOCK_BYTES", 8 * 31)
    cut = list(module.blocks(read_run(run_dir)))
    assert {block.stop - block.start for block in cut} == sizes
    assert (cut[0].start, cut[-1].stop) == (0, 12)
