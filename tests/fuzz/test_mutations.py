"""Mutated configurations and data files of every model: each is read, or refused within the limits.

The full count runs with `make thorough`, in parts. One mutation is made again by its number:
`python -m tests.fuzz configuration 4531 4532`.
"""

from collections import Counter
from pathlib import Path

import pytest
from tests.fuzz import cases
from tests.fuzz.seeds import SEEDS, write_folder

pytest.importorskip("skfem")

PARTS = [pytest.param(k, marks=pytest.mark.thorough) for k in range(10)]
SIZE = 5000
"""Of each kind in a part: 100 000 mutations in all."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("fuzz"))


def verdicts(kind: str, folder: Path, numbers: range) -> Counter[str]:
    found: Counter[str] = Counter()
    broken = []
    for number in numbers:
        case = getattr(cases, kind)(number, folder)
        verdict, value = case.examine()
        found[verdict] += 1
        if verdict == "broken":
            broken.append(f"{case.name}: {value}")
    assert not broken, "\n".join(broken)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS, ids=lambda seed: seed.name)
def test_unchanged_configuration_is_read(seed, folder: Path) -> None:
    path = folder / "whole.toml"
    path.write_text(seed.text, encoding="utf-8")
    assert cases.load(path, seed)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["configuration", "data"])
def test_mutations_are_read_or_refused(kind: str, folder: Path) -> None:
    found = verdicts(kind, folder, range(400))
    assert 0.03 < found["read"] / found.total() < 0.5, "the mutations reach both verdicts"


@pytest.mark.parametrize("kind", ["configuration", "data"])
@pytest.mark.parametrize("part", PARTS)
def test_many_mutations_are_read_or_refused(kind: str, part: int, folder: Path) -> None:
    verdicts(kind, folder, range(part * SIZE, (part + 1) * SIZE))
