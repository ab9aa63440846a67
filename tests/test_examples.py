"""The programs of examples/ run, print correct numbers, and those of the gallery a certificate."""

import ast
import contextlib
import io
import re
import runpy
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.signal

EXAMPLES = Path(__file__).parents[1] / "examples"


def in_differences(n: int) -> np.ndarray:
    """The plate of the example by finite differences on 3n/2 × n cells: its mean temperature, and the
    power of its heaters, at t = 6."""
    h = 1.0 / n
    s1, s2 = np.meshgrid((np.arange(3 * n // 2) + 0.5) * h, (np.arange(n) + 0.5) * h, indexing="ij")
    power = lambda x: np.clip(6.0 * (1.0 - x), 0.0, 2.0)  # noqa: E731

    def rate(t, x):
        around = np.pad(x, 1)  # 0 halfway between a cell at the wall and its mirror image
        around[[0, -1]] = -around[[1, -2]]
        around[:, [0, -1]] = -around[:, [1, -2]]
        sides = around[2:, 1:-1] + around[:-2, 1:-1] + around[1:-1, 2:] + around[1:-1, :-2]
        flame = 1.5 * np.exp(-30.0 * ((s1 - 0.5 - 0.3 * np.sin(t)) ** 2 + (s2 - 0.5) ** 2))
        return 0.05 * (sides - 4.0 * x) / h**2 + power(x) + flame

    steps = (
        int(6.0 * (8 * 0.05 / h**2 + 6.0) / 1.9) + 1
    )  # what the midpoint rule needs to be stable
    dt, x = 6.0 / steps, np.zeros(s1.shape)
    for k in range(steps):
        x = x + dt * rate((k + 0.5) * dt, x + 0.5 * dt * rate(k * dt, x))
    return np.array([x.mean(), power(x).sum() * h * h])


def thermostat(found: dict[str, float]) -> None:
    # The least eigenvalue of −κΔ on 1.5 × 1 with cold walls.
    assert found["decay_rate"] == pytest.approx(0.05 * np.pi**2 * (1 / 1.5**2 + 1), rel=1e-12)
    assert 0.0 <= found["power"] <= 2.0 * 1.5  # the greatest power, times the area
    here = np.array([found["mean_temperature"], found["power"]])
    coarse, fine = (np.abs(in_differences(n) - here) for n in (8, 32))
    order = np.log(coarse / fine) / np.log(32 / 8)
    assert np.all(order > 1.7), order  # 2, but for the free boundaries between cells


def viscoplasticity(found: dict[str, float]) -> None:
    # σ stays in the plane of the unit tension and shear, where it is of the size √(2/3)q.
    G, limit, side = 80e3, 250.0, 0.5  # each side of the path takes half a second
    path = np.array([(0, 0), (2, 0), (4, 0), (3.5, 2), (2, 3.5), (0, 4), (-2, 3), (-3, 0), (0, 0)])
    rates = 1e-3 * np.diff(path, axis=0) * np.sqrt([1.5, 2.0]) / side
    # dist(σ, K)' ≤ 2G‖ε'‖ − dist(σ, K)/τ, with equality as long as the flow keeps its direction.
    most = np.sqrt(1.5) * 2 * G * np.linalg.norm(rates, axis=1).max()
    above = {tau: found[f"peak_stress_{tau:g}"] - limit for tau in (0.2, 0.05, 0.005)}
    assert all(0.0 < over <= most * tau for tau, over in above.items())
    assert above[0.005] / above[0.05] == pytest.approx(0.1, rel=0.01)  # O(τ)

    def peak(tau: float) -> float:
        """The largest q at the saved times, by SciPy, one side of the path after the other."""
        sizes, s = [], np.zeros(2)
        for k, strain in enumerate(2 * G * rates):
            beyond = lambda s: max(0.0, 1.0 - np.sqrt(2 / 3) * limit / max(np.hypot(*s), 1.0))  # noqa: E731
            ts = side * k + np.linspace(0.0, side, 51)
            run = scipy.integrate.solve_ivp(
                lambda t, s, strain=strain: strain - beyond(s) * s / tau,  # noqa: B023
                ts[[0, -1]], s, "DOP853", ts, rtol=1e-11, atol=1e-9,
            )  # fmt: skip
            sizes, s = [*sizes, *np.hypot(*run.y)], run.y[:, -1]
        return np.sqrt(1.5) * max(sizes)

    # |Δq| ≤ √(3/2)‖Δσ‖ = √(3G)‖Δε_p‖ in the norm of the bound.
    for tau, over in above.items():
        assert abs(limit + over - peak(tau)) <= np.sqrt(3 * G) * found["error_bound"] + 1e-7


def predictive_control(found: dict[str, float]) -> None:
    S = 2 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1)
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-S, -0.5 * np.eye(3)]])
    B = np.eye(6)[:, [3]]
    held, moved, *_ = scipy.signal.cont2discrete((A, B, np.eye(6), 0.0), 0.25)
    cost = scipy.linalg.solve_discrete_are(held, moved, np.eye(6), [[0.5]])
    regulator = np.linalg.solve(0.5 + moved.T @ cost @ moved, moved.T @ cost @ held)
    # Far out every input is at its limit, and two trajectories approach as the plant alone does; near
    # 0 no move is at a limit, and they approach as under the regulator.
    M, rate = found["overshoot"], found["decay_rate"]
    assert 0.0 < rate <= -np.linalg.eigvals(A).real.max()
    for t in np.linspace(0.0, 20.0, 201):
        for loop in (A, A - B @ regulator):
            assert np.linalg.norm(scipy.linalg.expm(t * loop), 2) <= M * np.exp(-rate * t)
    # The trajectory is within its certified decay all along, and by the factor M where it begins.
    assert 1.0 <= found["room"] <= M * (1 + 1e-12)
    assert found["largest_input"] == 0.5  # it starts too far out for less


TRUE = {check.__name__: check for check in (predictive_control, thermostat, viscoplasticity)}


def test_examples_are_all_listed_in_this_test():
    assert {file.stem for file in EXAMPLES.glob("*.py")} == set(TRUE)
    told = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert all(f"`{name}.py`" in told for name in TRUE)


@pytest.mark.thorough
@pytest.mark.parametrize("name", TRUE)
def test_examples_print_correct_numbers_and_draw(name, tmp_path):
    found = runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"](tmp_path)
    TRUE[name](found)
    assert 0.0 < found["error_bound"] < 1e-3
    assert (tmp_path / f"{name}.png").stat().st_size > 20_000


GALLERY = sorted((EXAMPLES / "gallery").glob("plot_*.py"))
# These run in `make test`; all run in `make thorough` and in `make docs`.
QUICK = {"plot_certificate_true_error", "plot_circuit_bridge", "plot_game_vi"}


def test_gallery_has_a_description_a_figure_and_a_certificate_in_each_example():
    assert len(GALLERY) >= 20
    for file in GALLERY:
        text = file.read_text(encoding="utf-8")
        title, rule = (ast.get_docstring(ast.parse(text)) or "").split("\n")[:2]
        assert len(rule) >= len(title) and set(rule) == {"="}, file.name
        before, _, certificate = text.partition("# The certificate\n# ---------------\n")
        assert "plt.subplots(" in before and "title=" in before, f"{file.name}: no picture"
        # A status is printed as dvax says it, never as a constant of the example.
        assert ".status" in certificate or "error_bound" in certificate, file.name
        printed = re.findall(r"print\(.*", certificate)
        assert printed and not any("proved" in line for line in printed if "decay" not in line), (
            file
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "file",
    [pytest.param(f, marks=[] if f.stem in QUICK else [pytest.mark.thorough]) for f in GALLERY],
    ids=lambda file: file.stem,
)
def test_gallery_example_runs_and_labels_its_axes(file: Path):
    printed = io.StringIO()
    # As a user runs it: the strict promotion of the tests is for the library.
    with (
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
        contextlib.redirect_stdout(printed),
    ):
        runpy.run_path(str(file))
    figures = [plt.figure(number) for number in plt.get_fignums()]
    assert figures
    for figure in figures:
        for axes in figure.axes:
            assert axes.get_xlabel() or axes.get_ylabel(), "an axis without a name"
    plt.close("all")
    assert re.search(r"\b(proved|declared|estimated)\b|error bound", printed.getvalue())
