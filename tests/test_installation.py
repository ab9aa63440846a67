"""The archives of a release, installed by name from a local index into clean environments."""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

EXAMPLE = """
import jax
jax.config.update("jax_enable_x64", True)
import dvax
problem = dvax.Problem(
    A=dvax.generators.Scalar(-1.0),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(0.0, 0.5),
    f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
)
solution = dvax.solve(problem, -1.0, 0.0, 2.0, rtol=1e-10, atol=1e-10)
print(dvax.__file__, dvax.__version__, float(solution.xs[-1]))
"""
# The closed form: saturated until t = ln(8/5)/(3/2), active for 2 ln(10/9), then unloaded.
EXACT = 1.8360919559905713

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
EXTRAS = ("energy", "export", "fem", "parquet")


def run(*command: str | Path, succeeds: bool = True, **settings) -> subprocess.CompletedProcess:
    # Nothing of the source tree may be found instead of what was installed.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, timeout=1800,
        env=environment, **settings,
    )  # fmt: skip
    assert (done.returncode == 0) == succeeds, f"{command}\n{done.stdout}\n{done.stderr}"
    return done


def interpreter(version: str) -> str:
    """Return the Python of this version, or skip the test."""
    for name in (sys.executable, f"python{version}"):
        path = shutil.which(name)
        ask = [path, "-c", "import ensurepip, sys; print('%d.%d' % sys.version_info[:2])"]
        if path and subprocess.run(ask, capture_output=True, text=True).stdout.strip() == version:
            return path
    pytest.skip(f"there is no python{version} with ensurepip on the PATH")


class Index:
    """A folder in the form of a package index (PEP 503), with the wheel and the sdist of dvax."""

    def __init__(self, folder: Path):
        self.folder = folder / "simple"
        place = self.folder / "dvax"
        place.mkdir(parents=True)
        run(sys.executable, "-m", "hatchling", "build", "-d", place, cwd=ROOT)
        (self.wheel,), (self.sdist,) = place.glob("*.whl"), place.glob("*.tar.gz")
        self.version = self.wheel.name.split("-")[1]
        links = [f'<a href="{f.name}">{f.name}</a>' for f in (self.wheel, self.sdist)]
        (place / "index.html").write_text("<!DOCTYPE html>\n" + "\n".join(links))

    def install(self, python: Path, extras: str = "", *options: str) -> None:
        # dvax from this index, what it depends on from the usual one.
        name = f"dvax{extras}=={self.version}"
        extra = ["--extra-index-url", self.folder.as_uri(), *options]
        run(python, "-m", "pip", "install", "--quiet", *extra, name, cwd=self.folder)


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> Index:
    return Index(tmp_path_factory.mktemp("index"))


def clean(python: str, place: Path) -> Path:
    run(python, "-m", "venv", place)
    return place / "bin" / "python"


def check_example(python: Path, version: str, place: Path) -> None:
    where, found, value = run(python, "-c", EXAMPLE, cwd=place).stdout.split()
    assert Path(where).is_relative_to(python.parents[1]) and found == version
    assert abs(float(value) - EXACT) < 1e-8


@pytest.mark.thorough
def test_sdist_contains_what_the_wheel_is_built_from(index: Index):
    inside = {name.partition("/")[2] for name in tarfile.open(index.sdist).getnames()}
    package = {name for name in zipfile.ZipFile(index.wheel).namelist() if name.startswith("dvax/")}
    assert {f"src/{name}" for name in package} <= inside
    assert {"LICENSE", "CITATION.cff", "CHANGELOG.md", "README.md", "Makefile"} <= inside
    ours = {
        name
        for folder in ("src", "tests", "docs")
        for name in run("git", "ls-files", folder, cwd=ROOT).stdout.split()
    }
    assert ours <= inside


@pytest.mark.thorough
@pytest.mark.parametrize("version", PYTHONS)
def test_wheel_installs_by_name_with_every_extra(version: str, index: Index, tmp_path: Path):
    python = clean(interpreter(version), tmp_path / "clean")
    index.install(python)
    check_example(python, index.version, tmp_path)
    program = python.parent / "dvax"
    for command in ([program], [python, "-m", "dvax"]):
        told = run(*command, succeeds=False, cwd=tmp_path).stderr
        assert "pip install 'dvax[app]'" in told and "Traceback" not in told
    index.install(python, "[app]")
    assert run(program, "--version").stdout == f"dvax {index.version}\n"
    run(program, "demo", "-o", tmp_path / "demo", cwd=tmp_path)
    assert (tmp_path / "demo" / "report.html").stat().st_size > 100_000
    index.install(python, f"[{','.join(EXTRAS)}]")
    facts = json.loads(run(program, "doctor", "--json").stdout)["facts"]
    for extra in EXTRAS:
        assert "incomplete" not in facts[f"extra {extra}"].get("remark", ""), facts
    run(python, "-m", "pip", "check")


@pytest.mark.thorough
def test_sdist_installs_by_name(index: Index, tmp_path: Path):
    python = clean(sys.executable, tmp_path / "clean")
    index.install(python, "", "--no-binary", "dvax")
    check_example(python, index.version, tmp_path)


@pytest.mark.thorough
def test_installed_package_is_typed(index: Index, tmp_path: Path):
    python = clean(sys.executable, tmp_path / "clean")
    index.install(python)
    program = tmp_path / "program.py"
    program.write_text("import dvax\nK = dvax.sets.Box(0.0, 1.0)\nreveal_type(K)\nK.absent\n")
    check = [sys.executable, "-m", "pyright", "--pythonpath", python, program]
    told = run(*check, succeeds=False, cwd=tmp_path).stdout
    assert re.search(r'Type of "K" is "Box"', told), told
    assert re.search(r'"absent" for class "Box"', told), told
