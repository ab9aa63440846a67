"""A mutated configuration or data file either loads or raises an InputError."""

import random

import pytest

from dvax.app.runs.config import load_config
from dvax.errors import InputError

from .example import LOAD, write

VALUES = (
    "0 1 -1 2.5 1e308 -0.0 nan inf true [] {} [1] [[1,2]] [1,2] {a=1} 'x' '' '1 s' '2 um' '3 um/s' "
    "'2 MPa' '1e999 s' '1 s**9' 't' 's' '9**9**9' 'load.csv' 'strip.npy' '../a' '/' '\\u0000' "
    "1979-05-27 07:32:00 99999999999999999999 0x10 'linear' 'é m' '''a''' \"\\u0000\" \"a\\nb\""
).split(" ")
KEYS = (
    "alpha beta kappa0 b_u points length lengths file value expression knots series profile column "
    "kind per_unit companion end frames dt rtol atol method points_of_interest report time x"
).split(" ")


def mutate(dice: random.Random, text: str) -> str:
    lines = text.splitlines()
    for _ in range(dice.randint(1, 3)):
        i = dice.randrange(len(lines))
        match dice.randrange(6):
            case 0:
                del lines[i]
            case 1:
                lines.insert(i, f"{dice.choice(KEYS)} = {dice.choice(VALUES)}")
            case 2 | 3 if "=" in lines[i]:
                lines[i] = f"{lines[i].split('=')[0]}= {dice.choice(VALUES)}"
            case 4:
                j = dice.randrange(len(lines))
                lines[i], lines[j] = lines[j], lines[i]
            case _:
                at = dice.randrange(len(lines[i]) + 1)
                lines[i] = (
                    lines[i][:at] + chr(dice.choice((34, 44, 61, 91, 0, 233, 48))) + lines[i][at:]
                )
        if not lines:
            lines = [""]
    return "\n".join(lines)


def loads(path) -> bool:
    try:
        config = load_config(path)
    except InputError as refused:
        assert refused.problems
        for problem in refused.problems:
            assert problem.place and problem.given and problem.rule and problem.fix, problem
        return False
    assert config.tree()
    return True


@pytest.mark.parametrize("cases", [1500, pytest.param(100_000, marks=pytest.mark.thorough)])
def test_config_fuzzing_loads_or_raises_input_error(cases, tmp_path):
    dice = random.Random(cases)
    path = write(tmp_path, {"solver.rtol": 1e-7, "initial.companion": "1 um"})
    text = path.read_text()
    verdicts = []
    for _ in range(cases):
        path.write_text(mutate(dice, text), encoding="utf-8")
        verdicts.append(loads(path))
    assert 0.02 < sum(verdicts) / cases < 0.5, "the mutations reach both verdicts"


@pytest.mark.parametrize("cases", [500, pytest.param(20_000, marks=pytest.mark.thorough)])
def test_data_fuzzing_loads_or_raises_input_error(cases, tmp_path):
    dice = random.Random(cases)
    changes = {"demand.profile": {"file": "strip.npy"}, "boundary": {"file": "nodes.csv"}}
    nodes = "s [mm],weight [mm]\n" + "".join(f"{i},0.5\n" for i in range(8))
    path = write(tmp_path, changes, nodes_csv=nodes)
    files = {
        name: (tmp_path / name).read_bytes() for name in ("load.csv", "strip.npy", "nodes.csv")
    }
    assert files["load.csv"] == LOAD.encode() and loads(path)
    verdicts = []
    for _ in range(cases):
        name = dice.choice(list(files))
        content = bytearray(files[name])
        for _ in range(dice.randint(1, 3)):
            at = dice.randrange(len(content))
            content[at : at + dice.randint(0, 3)] = bytes(dice.choices(range(256), k=1))
        (tmp_path / name).write_bytes(content)
        verdicts.append(loads(path))
        (tmp_path / name).write_bytes(files[name])
    assert 0.02 < sum(verdicts) / cases < 0.9, "the mutations reach both verdicts"
