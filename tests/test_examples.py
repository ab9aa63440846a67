"""The programs of examples/ run, and their numbers are what they say."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
NUMBERS = {
    "predictive_control": {"decay_rate": 0.231269, "overshoot": 1.87381},
    "thermostat": {"mean_temperature": 0.721507, "power": 1.62327, "decay_rate": 0.712805},
    "viscoplasticity": {"peak_stress_0.05": 336.097, "peak_stress_0.005": 258.648},
}


def test_every_example_is_here():
    assert {file.stem for file in EXAMPLES.glob("*.py")} == set(NUMBERS)
    told = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert all(f"`{name}.py`" in told for name in NUMBERS)


@pytest.mark.thorough
@pytest.mark.parametrize("name", NUMBERS)
def test_an_example_prints_its_numbers_and_draws(name, tmp_path):
    found = runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"](tmp_path)
    for figure, value in NUMBERS[name].items():
        assert found[figure] == pytest.approx(value, rel=1e-3)
    assert 0.0 < found["error_bound"] < 1e-3
    assert (tmp_path / f"{name}.png").stat().st_size > 20_000
