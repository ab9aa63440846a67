"""Run directories are correct after numbers overflow, and after a solve rejects its input."""

import json
import math
import re
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.app.cli.contact import write_config
from tests.selection import mostly_thorough
from typer.testing import CliRunner

import dvax
from dvax._figure_text import entry_text
from dvax.app.cli.program import app
from dvax.app.plots.lines import LARGEST, positive
from dvax.app.plots.theme import number
from dvax.app.runs import contact_run, driver
from dvax.app.runs.blocks import block_length, longest_block
from dvax.app.runs.config import load_config
from dvax.app.runs.figure import Figure
from dvax.app.runs.json_files import json_ready
from dvax.app.runs.schema import SolverKeys
from dvax.app.runs.solver_options import check_dt_max
from dvax.errors import InputError, InputProblem, SolveError
from dvax.evolution.rows import all_finite

INFINITE = {"Hadamard": [("d_x = 0.2", "d_x = 900.0"), ("end = 1.0", "end = 1.2")]}
TINY = {"norms": [('beta = "0.5 MPa/um"', "beta = 1e-300")]}


@pytest.mark.parametrize(
    ("value", "spelled", "shown"),
    [(math.inf, "inf", "∞"), (-math.inf, "-inf", "−∞"), (math.nan, "nan", "NaN"), (1.5, 1.5, "1.5"),
     (np.float64(np.inf), "inf", "∞")],
)  # fmt: skip
def test_nonfinite_numbers_have_one_spelling_in_json_and_one_in_text(value, spelled, shown) -> None:
    content = json_ready({"rows": [{"value": value}], "pair": (value, "text", None, True)})
    text = json.dumps(content, allow_nan=False)
    assert json.loads(text) == {
        "rows": [{"value": spelled}], "pair": [spelled, "text", None, True],
    }  # fmt: skip
    np.testing.assert_equal(float(spelled), float(value))
    for known in (value, spelled):
        assert number(known) == entry_text({"value": known}) == shown
    bound = {"value": spelled, "bound": "proved", "error": spelled}
    assert entry_text(bound) == ("≤ 1.5" if spelled == 1.5 else shown)
    meaning = Figure(value, "1", "a bound", bound="proved").to_json()["meaning"]
    assert ("gives no bound" in meaning) == (not math.isfinite(value))


def test_log_axis_covers_the_curve() -> None:
    values = np.array([0.0, -1.0, np.inf, np.nan, 1e300, LARGEST, 1e-300])
    np.testing.assert_array_equal(np.isnan(positive(values)), [True] * 5 + [False] * 2)


def test_constants_that_overflow_give_no_warning_and_a_note() -> None:
    c = dvax.Constants(
        gamma=1.0, L_F=1.0, alpha_h=1.0, beta_h=0.0, alpha_f=900.0, beta_f=1.0, M=1.0, omega=-1.0,
        m_P=1.0, norm_P_inv=1.0, one_sided=900.0,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        row = next(row for row in c.table(1.2) if row.name == "hadamard")
        assert c.separation(1.2) == c.sharp_separation(1.2) == c.largest_separation(1.2) == math.inf
    assert row.value == math.inf and "gives no bound" in row.meaning


@pytest.mark.parametrize("changes", mostly_thorough([*INFINITE.values(), *TINY.values()], []))
def test_run_that_overflows_writes_all_files(tmp_path: Path, changes: Any) -> None:
    config, out = write_config(tmp_path / "in", *changes), tmp_path / "out"
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        checked = CliRunner().invoke(app, ["check", str(config)])
        result = CliRunner().invoke(app, ["run", str(config), "-o", str(out)])
    assert checked.exit_code == 0 and result.exit_code == 0, result.output
    assert not [w for w in warned if issubclass(w.category, RuntimeWarning)]
    assert "∞" in result.stdout and (out / "report.html").is_file()
    assert "∞" in (out / "report.html").read_text(encoding="utf-8")

    def no_constant(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    for name in ("manifest.json", "summary.json"):
        json.loads((out / name).read_text(), parse_constant=no_constant)
    assert json.loads((out / "manifest.json").read_text())["status"] == "finished"
    if changes is INFINITE["Hadamard"]:
        bound = json.loads((out / "summary.json").read_text())["error_bound_x"]
        assert bound["value"] == "inf" and "gives no bound" in bound["meaning"]
        assert "∞" in checked.stdout


REFUSED = InputError(InputProblem("dvax.solve(dt_max)", "1e-12", "it is too short", "Write more"))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("error", "code"),
    [(REFUSED, 2), (SolveError("f is nan at t = 3."), 3), (TypeError("odd"), None)],
)
def test_failed_solve_closes_the_manifest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, code: int | None
) -> None:
    def solve(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(contact_run, "solve", solve)
    config, out = load_config(write_config(tmp_path / "in")), tmp_path / "out"
    if code is None:
        with pytest.raises(TypeError, match="odd"):
            driver.run(config, out)
    else:
        outcome = driver.run(config, out)
        assert (outcome.exit_code, outcome.status, outcome.has_results) == (code, "failed", False)
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["status"] == "failed" and manifest["frames"] == 0
    if code == 2:
        assert manifest["stop_reason"].startswith("strip.toml: solver.dt_max: got 1e-12")
    if code is None:
        assert manifest["stop_reason"] == "TypeError: odd"


@pytest.mark.parametrize("bad", [0, 2, 3])
def test_nonfinite_state_is_a_failure_with_its_time(bad: int) -> None:
    ts = np.array([1.0, 1.5, 2.0])
    solution = dvax.solve(
        dvax.models.Contact(
            alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0, kappa0=0.5, g=1.0, ell=3.0
        ).problem, -1.0, 0.5, 2.0, ts=ts, dt=0.25,
    )  # fmt: skip
    assert all_finite(solution, 0.5) is solution
    fields = {name: getattr(solution, name) for name in solution.__dataclass_fields__}
    xs = np.asarray(solution.xs).copy()
    xs[bad:] = np.inf
    last = {"x": jnp.asarray(np.inf)}
    spoiled = type(solution)(**fields | {"xs": xs, "stats": solution.stats | last})
    with pytest.raises(SolveError, match="ceased to be finite between t = ") as caught:
        all_finite(spoiled, 0.5)
    assert isinstance(caught.value.solution, dvax.Solution)
    assert len(caught.value.solution.ts) == bad
    assert f"t = {[0.5, 1.0, 1.5, 2.0][bad]:g} and" in str(caught.value)


@pytest.mark.parametrize("frames", [2, 3, 9, 81, 1000])
def test_longest_block_is_what_a_solve_covers(frames: int) -> None:
    times = np.linspace(0.0, 1.0, frames)
    block = block_length(frames, 24)
    spans = [
        times[min(first + block, frames) - 1] - times[max(first - 1, 0)]
        for first in range(0, frames, block)
    ]
    span = longest_block(times, 24)
    assert span == max(spans)
    with pytest.raises(dvax.InputError) as caught:
        check_dt_max(SolverKeys(dt_max=1e-9 * span, max_steps=1000), span, "a.toml: solver")
    (problem,) = caught.value.problems
    assert problem.place == "a.toml: solver.dt_max"
    named = re.search(r"dt_max = (\S+) or more", problem.fix)
    assert named is not None
    check_dt_max(SolverKeys(dt_max=float(named[1]), max_steps=1000), span, "")


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["ETD2RK", "ETD4RK"])
def test_suggested_max_steps_of_a_run_suffices(tmp_path: Path, method: str) -> None:
    def ended(folder: str, steps: int) -> driver.RunOutcome:
        keys = f'max_steps = {steps}\nmethod = "{method}"'
        config = write_config(tmp_path / folder, ("dt = 0.05", keys))
        return driver.run(load_config(config), tmp_path / folder / "out")

    failed = ended("few", 2)
    assert failed.exit_code == 3 and "of a run of the length 1," in failed.stop_reason
    named = re.search(r"Write solver\.max_steps = (\d+),", failed.stop_reason)
    assert named and ended("enough", int(named[1])).exit_code == 0


@pytest.mark.parametrize(
    ("dtype", "x64", "said"),
    [("float64", True, "operation. Pass rtol = 2.3e-14 or more"),
     ("float32", True, "Give x0 as float64, or pass rtol = 1.3e-05 or more"),
     ("float32", False, r"jax_enable_x64', True\) before anything else, or pass rtol = 1.3e-05")],
)  # fmt: skip
def test_suggested_tolerance_for_the_precision_suffices(dtype: str, x64: bool, said: str) -> None:
    from dvax.evolution.arguments import warn_precision

    before = jax.config.read("jax_enable_x64")
    try:
        jax.config.update("jax_enable_x64", x64)
        with pytest.warns(UserWarning, match=said) as told:
            warn_precision(jnp.zeros(2, dtype), 1e-20)
        named = re.search(r"rtol = (\S+) or more", str(told[0].message))
        assert named
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warn_precision(jnp.zeros(2, dtype), float(named[1]))
    finally:
        jax.config.update("jax_enable_x64", before)


def test_byte_order_mark_is_ignored(tmp_path: Path) -> None:
    config = write_config(tmp_path)
    config.write_bytes(b"\xef\xbb\xbf" + config.read_bytes())
    assert load_config(config).time.end == 1.0
