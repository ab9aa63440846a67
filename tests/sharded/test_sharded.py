"""A state on eight devices has the solution of one device, and its steps send what is documented."""

import doctest
import json
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from tests.selection import mostly_thorough

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "sharding.md"

STATE = 16 * 24
EXPECTED = {
    "diagonal, a box per point, fixed steps": [],
    "diagonal, a box per point, ETD2RK": [["all-reduce", 2, 96, False]],
    "diagonal, a box per point, the default": [["all-reduce", 6, 344, False]],
    "a number, the orthant, ETD4RK": [["all-reduce", 6, 328, False]],
    "zero, a box, ExpRosenbrock": [["all-reduce", 4, 256, False]],
    "a number, a moving box, DormandPrince": [["all-reduce", 7, 352, False]],
    "a number, a ball, fixed steps": [["all-reduce", 2, 16, False]],
    "two parts, ETD2RK": [["all-reduce", 2, 192, False]],
    # The whole state, once for each forward transform.
    "a periodic line, fixed steps": [["all-gather", 2, 2 * 8 * 512, False]],
    "a line between zeros, fixed steps": [["all-gather", 2, 2 * 8 * 512, False]],
    # Two transforms forward and two back, each of the entries of one device.
    "an insulated plane, fixed steps": [["all-to-all", 4, 4 * 8 * STATE // 8, False]],
    # Along the periodic axis 24 real numbers become 13 complex ones, padded to 16.
    "a plane of two kinds, ETD2RK": [
        ["all-reduce", 3, 104, False],
        ["all-to-all", 4, 4 * 16 * 16 * 16 // 8, False],
    ],
}
"""For each case the collective operations of a step: kind, count, bytes on a device, optional."""

OTHER_STEPS = "a number, a moving box, DormandPrince"
"""With data that moves in t a rounding decides here whether a step is accepted, so that both runs keep
the tolerance with other steps."""

QUICK = ["diagonal, a box per point, fixed steps", "an insulated plane, fixed steps"]


def on_eight_devices(*names: str) -> dict:
    program = [sys.executable, str(HERE / "eight_devices.py"), json.dumps(names)]
    return json.loads(subprocess.run(program, check=True, capture_output=True, text=True).stdout)


@pytest.mark.slow
@pytest.mark.parametrize("names", mostly_thorough([QUICK, sorted({*EXPECTED} - {*QUICK})], [QUICK]))
def test_eight_devices_have_the_solution_of_one(names):
    for name, found in on_eight_devices(*names).items():
        if name == OTHER_STEPS:
            assert found["apart"] < 3e-5, name
        else:
            assert found["apart"] < 1e-13, name
            assert found["steps"][0] == found["steps"][1], name
        assert found["keeps its sharding"], name
        assert found["collectives"] == EXPECTED[name], name


@pytest.mark.thorough
@pytest.mark.parametrize("check", ["gradient", "dense", "bounds"])
def test_what_follows_a_solve_is_that_of_one_device(check):
    found = on_eight_devices(check)[check]
    assert found["apart"] < 1e-13
    assert "points" in found.get("spec", "points")


@pytest.mark.thorough
def test_states_that_cannot_be_sharded_are_refused():
    explicit, not_finite, one_device = on_eight_devices("refused")["refused"]
    assert "explicit axes" in explicit and "AxisType.Auto" in explicit
    assert "nan at index (256,)" in not_finite
    assert "a state on one device" in one_device


PAGE_ON_EIGHT_DEVICES = f"""
    import doctest, os, re
    text = open({str(PAGE)!r}, encoding="utf-8").read().replace("# doctest: +SKIP", "")
    code = "\\n".join(re.findall(r"^```python\\n(.*?)^```$", text, re.M | re.S))
    test = doctest.DocTestParser().get_doctest(code, {{}}, "page", None, 0)
    runner = doctest.DocTestRunner(optionflags={doctest.NORMALIZE_WHITESPACE})
    runner.run(test)
    assert runner.summarize().failed == 0
"""


@pytest.mark.thorough
def test_page_has_the_output_of_eight_devices():
    program = [sys.executable, "-c", textwrap.dedent(PAGE_ON_EIGHT_DEVICES)]
    done = subprocess.run(program, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
