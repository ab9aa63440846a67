"""Saved rows that go into a store while the run goes on: `dvax.solve(save=…)`."""

import json
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import dvax
from dvax.evolution import streaming

END, ROWS = 5.0, 101
TIMES = np.linspace(0.0, END, ROWS)


def problem(growth=0.0):
    """x' = -x/2 + 3 sin t - u + growth x², u = x held in [0, 1/2]."""
    return dvax.Problem(
        A=dvax.generators.Scalar(-0.5), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: 3.0 * jnp.sin(t) - u + growth * x**2,
        h=lambda t, x, u, args: x,
    )  # fmt: skip


PROBLEM, GROWING = problem(), problem(1.0)


@pytest.fixture(autouse=True)
def short_pieces(monkeypatch):
    """Pieces of eight rows of one number, so that a hundred rows are thirteen pieces."""
    monkeypatch.setattr(streaming, "_PIECE_BYTES", 8 * 8)


@pytest.fixture(scope="module")
def whole():
    return dvax.solve(PROBLEM, -1.0, 0.0, END, ts=TIMES, rtol=1e-8)


def rows(path):
    with xarray.open_zarr(path) as data:
        return {str(name): np.asarray(array) for name, array in data.variables.items()}


@pytest.mark.slow
def test_rows_are_those_of_a_run_without_a_store(whole, tmp_path):
    store = dvax.ZarrStore(tmp_path / "run.zarr")
    end = dvax.solve(PROBLEM, -1.0, 0.0, END, ts=TIMES, rtol=1e-8, save=store)
    data = rows(store.path)
    assert store.complete_rows == ROWS and np.array_equal(data["time"], TIMES)
    assert set(data) == {"time", *whole.to_xarray().data_vars}
    for name, reference in (("x", whole.xs), ("u", whole.us), ("y", whole.ys)):
        np.testing.assert_allclose(data[name], reference, atol=1e-6, err_msg=name)
    # The end, with the integral of the defect over all pieces.
    assert end.xs.shape == (1,) and float(end.xs[0]) == data["x"][-1]
    assert float(end.defect[0]) == data["defect"][-1]
    assert (np.diff(data["defect"]) >= 0).all() and data["defect"][-1] > 0
    assert int(end.stats["steps"]) >= int(whole.stats["steps"])


@pytest.mark.slow
def test_progress_counts_the_steps_of_all_pieces(tmp_path, capfd):
    end = dvax.solve(
        PROBLEM, -1.0, 0.0, END, ts=TIMES, rtol=1e-8, save=dvax.ZarrStore(tmp_path / "run.zarr"),
        progress=True,
    )  # fmt: skip
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 13 and f"100%, {int(end.stats['steps'])} steps" in lines[-1]


@pytest.mark.thorough
def test_bound_of_the_end_holds_for_the_whole_run(tmp_path):
    found = dvax.verify(PROBLEM, -1.0, 0.0, END).constants
    options = dict(constants=found, method=dvax.ETD2RK(), rtol=1e-4, atol=1e-4)
    end = dvax.solve(
        PROBLEM, -1.0, 0.0, END, ts=TIMES, save=dvax.ZarrStore(tmp_path / "run.zarr"), **options
    )
    exact = dvax.solve(PROBLEM, -1.0, 0.0, END, rtol=1e-12, atol=1e-12)
    bound = dvax.bound_error(PROBLEM, end, found)
    error = abs(float(end.xs[0] - exact.xs[0]))
    assert 1e-9 < error <= float(bound.x[-1])


@pytest.mark.slow
def test_last_piece_that_is_not_full_and_an_end_behind_the_last_row(tmp_path):
    times = np.linspace(0.5, 4.0, 19)
    store = dvax.ZarrStore(tmp_path / "run.zarr")
    end = dvax.solve(PROBLEM, -1.0, 0.0, END, ts=times, save=store)
    assert store.complete_rows == 19 and np.array_equal(rows(store.path)["time"], times)
    assert float(end.stats["t"]) == END and float(end.ts[0]) == 4.0


@pytest.mark.thorough
def test_tuple_state_and_single_row(tmp_path):
    pair = dvax.Problem(
        A=dvax.generators.Product(dvax.generators.Scalar(-1.0), dvax.generators.Scalar(-2.0)),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: (u, jnp.zeros(3)), h=lambda t, x, u, args: x[1][0] - u,
        state_space=dvax.spaces.Product(dvax.spaces.Euclidean(()), dvax.spaces.Euclidean((3,))),
        control_space=dvax.spaces.Euclidean(()),
    )  # fmt: skip
    store = dvax.ZarrStore(tmp_path / "run.zarr")
    dvax.solve(pair, (1.0, jnp.ones(3)), 0.0, 1.0, ts=[1.0], save=store)
    data = rows(store.path)
    np.testing.assert_allclose(data["x1"], np.full((1, 3), np.exp(-2.0)), rtol=1e-6)


@pytest.mark.slow
def test_failed_run_keeps_the_rows_that_it_reached(tmp_path):
    store = dvax.ZarrStore(tmp_path / "run.zarr")
    with pytest.raises(dvax.SolveError) as caught:
        dvax.solve(GROWING, 2.0, 0.0, END, ts=TIMES, save=store)
    data = rows(store.path)
    assert 0 < store.complete_rows < ROWS and len(data["time"]) == store.complete_rows
    assert np.isfinite(data["x"]).all() and "infinite" not in str(data["time"][-1])
    assert isinstance(caught.value.solution, dvax.Solution)
    quiet = dvax.solve(
        GROWING,
        2.0,
        0.0,
        END,
        ts=TIMES,
        throw=False,
        save=dvax.ZarrStore(store.path, overwrite=True),
    )
    assert quiet.result != dvax.RESULTS.successful and rows(store.path).keys() == data.keys()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (dict(ts=None), "ts=np.linspace"),
        (dict(dense=True), "Leave out dense="),
        (dict(events=[dvax.Event(lambda t, x, u: x)]), "Leave out events="),
        (dict(save="run.zarr"), "dvax.ZarrStore"),
        (dict(ts=[0.0, 9.0]), "ts"),
    ],
)
def test_wrong_arguments_are_refused_and_nothing_is_written(tmp_path, options, told):
    given = dict(ts=TIMES, save=dvax.ZarrStore(tmp_path / "run.zarr")) | options
    with pytest.raises(dvax.InputError, match=told):
        dvax.solve(PROBLEM, -1.0, 0.0, END, **given)
    assert not (tmp_path / "run.zarr").exists()


def test_derivatives_through_files_are_refused(tmp_path):
    def end(x0):
        store = dvax.ZarrStore(tmp_path / "run.zarr")
        return dvax.solve(PROBLEM, x0, 0.0, END, ts=TIMES, save=store).xs[0]

    with pytest.raises(dvax.InputError, match="Leave out save="):
        jax.grad(end)(-1.0)


def test_files_that_are_there_are_kept_unless_they_are_a_store(tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.txt").write_text("years of work")
    for overwrite in (False, True):
        with pytest.raises(dvax.InputError, match="something at this path"):
            dvax.solve(
                PROBLEM, -1.0, 0.0, END, ts=TIMES, save=dvax.ZarrStore(other, overwrite=overwrite)
            )
    assert (other / "thesis.txt").read_text() == "years of work"


KILLED = """
import os, sys, numpy as np, jax
jax.config.update("jax_enable_x64", True)
import dvax
from dvax.evolution import streaming
streaming._PIECE_BYTES = 64
sys.path.insert(0, {folder!r})
from test_streaming import PROBLEM, TIMES, END
class Killing(dvax.ZarrStore):
    def write(self, rows):
        super().write(rows)
        if self.complete_rows >= 40:
            os.kill(os.getpid(), 9)
dvax.solve(PROBLEM, -1.0, 0.0, END, ts=TIMES, save=Killing({path!r}))
"""


@pytest.mark.thorough
def test_store_of_a_killed_run_opens_with_its_complete_rows(whole, tmp_path):
    path = tmp_path / "run.zarr"
    code = KILLED.format(folder=str(Path(__file__).parent), path=str(path))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == -9, done.stderr
    data = rows(path)
    assert len(data["time"]) == 40 and np.array_equal(data["time"], TIMES[:40])
    np.testing.assert_allclose(data["x"], whole.xs[:40], atol=1e-5)


LARGE = """
import json, resource, sys, time, numpy as np, jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import dvax
n, frames = 200_000, {frames}
problem = dvax.Problem(
    A=dvax.generators.Scalar(-0.5), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    f=lambda t, x, u, args: jnp.sin(t) - u, h=lambda t, x, u, args: x,
)
x0 = jnp.linspace(-1.0, 1.0, n)
def run(count, path):
    ts = np.linspace(0.0, 10.0, count)
    return dvax.solve(
        problem, x0, 0.0, 10.0, ts=ts, dt=10.0 / 64, method=dvax.ETD1(), save=dvax.ZarrStore(path)
    )
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
run(100, {path!r} + "/small.zarr")
before = peak()
start = time.time()
run(frames, {path!r} + "/large.zarr")
print(json.dumps(dict(before=before, after=peak(), seconds=time.time() - start)))
"""


@pytest.mark.thorough
def test_memory_does_not_grow_with_the_rows(tmp_path):
    frames = 2100  # times x, u and y of 200 000 numbers: 10 GB
    code = textwrap.dedent(LARGE.format(frames=frames, path=str(tmp_path)))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    print(told)
    assert told["after"] - told["before"] < 100 and told["after"] < 1024
    with xarray.open_zarr(tmp_path / "large.zarr") as data:
        assert data.sizes["time"] == frames and bool(np.isfinite(data.x[-1]).all())
