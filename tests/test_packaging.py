"""The package: a complete wheel, its requirements, a fast command line."""

import email
import importlib.metadata
import itertools
import os
import re
import subprocess
import sys
import time
import tomllib
import zipfile
from pathlib import Path

import pytest

import dvax

ROOT = Path(__file__).parents[1]

# Each of these takes longer to load than a person waits for --help.
HEAVY = ["jax", "jaxlib", "numpy", "scipy", "equinox", "diffrax", "pydantic", "xarray", "zarr"]
HEAVY += ["pandas", "plotly", "matplotlib", "pint"]


def run(*command: str | Path, **settings) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, timeout=600, **settings
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder, cwd=ROOT)
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_contains_every_file_of_the_package(wheel: Path):
    inside = set(zipfile.ZipFile(wheel).namelist())
    package = ROOT / "src" / "dvax"
    files = {
        str(file.relative_to(ROOT / "src"))
        for file in package.rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }
    assert files - inside == set()
    assert {name.split("/")[0] for name in inside - files} == {f"dvax-{version(wheel)}.dist-info"}


def test_wheel_contains_the_demo(wheel: Path):
    demo = {
        name.rpartition("/")[2]: info.file_size
        for info in zipfile.ZipFile(wheel).infolist()
        if (name := info.filename).startswith("dvax/app/runs/demo/")
    }
    assert {"rough_strip.toml", "load.csv"} <= set(demo)
    assert all(size > 0 for size in demo.values())


def metadata(wheel: Path) -> email.message.Message:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        return email.message_from_bytes(archive.read(name))


def version(wheel: Path) -> str:
    return metadata(wheel)["Version"]


def test_metadata_lists_the_requirements(wheel: Path):
    about = metadata(wheel)
    assert about["Requires-Python"] == ">=3.11"
    assert about["License-Expression"] == "Apache-2.0"
    assert set(about.get_all("Provides-Extra", [])) == {
        "app",
        "dev",
        "docs",
        "energy",
        "export",
        "fem",
        "parquet",
    }
    core = [need for need in about.get_all("Requires-Dist", []) if "extra ==" not in need]
    assert {re.split("[<>]", need)[0] for need in core} == {
        *("jax", "equinox", "diffrax", "numpy", "optimistix", "scipy"),
    }
    assert all(">=" in need for need in core)
    # Traced programs are read, so that a minor release of JAX can change what they look like.
    assert [need for need in core if "<" in need] == ["jax<0.13,>=0.10"]
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("entry_points.txt"))
        assert "dvax = dvax.app.cli:main" in archive.read(name).decode()


def test_dependencies_page_names_the_declared_packages():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needs = [
        *declared["dependencies"],
        *itertools.chain(*declared["optional-dependencies"].values()),
    ]
    page = (ROOT / "docs" / "dependencies.md").read_text()
    rows = re.findall(r"^\| ([a-z][\w\[\], -]*) \| [^|]+ \|$", page, re.MULTILINE)
    named = {name for row in rows for name in row.split(", ")}
    named -= {"package", "problem"}
    assert named == {re.split("[<>]", need)[0] for need in needs} - {
        "dvax[export,fem,parquet]",
        "dvax[app,energy,export,fem]",
    }


def test_library_imports_its_declared_dependencies():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    code = "\n".join(path.read_text() for path in (ROOT / "src" / "dvax").rglob("*.py"))
    for name in (re.split("[<>]", need)[0] for need in declared):
        assert re.search(rf"^\s*(import|from) {name}\b", code, re.MULTILINE), name


def test_version_is_that_of_the_installed_package():
    assert dvax.__version__ == importlib.metadata.version("dvax")
    # Release, development version or none: what PEP 440 can order.
    assert re.match(r"\d+\.\d+", dvax.__version__)


def test_citation_has_the_version_of_the_newest_release():
    """A release has a heading `## [1.2.3] - 2027-01-31` in the changelog."""
    releases = re.findall(r"^## \[(\d[^\]]*)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    cited = re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited == releases[:1]


def test_conda_recipe_has_the_requirements_of_the_package():
    """Conda packages have no extras: the recipe has those of the command line too."""
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = declared["project"]
    recipe = (ROOT / "conda" / "recipe.yaml").read_text()
    parts = re.findall(r"^  (host|run|run_constraints):\n((?:    - .+\n)+)", recipe, re.MULTILINE)
    found = {part: {line.strip()[2:] for line in lines.splitlines()} for part, lines in parts}
    apart = {"python ${{ python_min }}.*", "python >=${{ python_min }}", "pip"}

    def spelled(needs):
        return {re.sub("([<>])", r" \1", need, count=1).replace("flatbuffers", "python-flatbuffers")
                for need in needs}  # fmt: skip

    extras = project["optional-dependencies"]
    assert found["host"] - apart == spelled(declared["build-system"]["requires"])
    assert found["run"] - apart == spelled([*project["dependencies"], *extras["app"]])
    optional = [need for name in ("energy", "export", "fem", "parquet") for need in extras[name]]
    assert found["run_constraints"] == spelled(optional)
    assert f'python_min: "{project["requires-python"].removeprefix(">=")}"' in recipe


def test_page_on_data_lists_every_file_of_data():
    done = run("git", "ls-files", cwd=ROOT)
    code = {"", *".py .md .toml .yaml .cff .txt .css .js .html .typed .rst .lock".split()}
    data = {name for name in done.stdout.split() if Path(name).suffix not in code}
    page = (ROOT / "docs" / "contributors" / "data.md").read_text()
    assert data == set(re.findall(r"^\| `([^`]+)`", page, re.MULTILINE))


def test_lock_file_contains_only_versions():
    for line in (ROOT / "requirements-dev.lock").read_text().splitlines():
        if not line.lstrip().startswith("#"):
            assert "==" in line and "://" not in line and not line.startswith("-"), line


def test_environment_is_consistent():
    # `make` installs the lock without resolving it, so a package that the lock forgot shows here.
    run(sys.executable, "-m", "pip", "check")


def help_of(*arguments: str) -> str:
    """The large modules that are loaded after `dvax ARGUMENTS --help`."""
    code = f"""
import sys
from dvax.app.cli import main
sys.argv = ["dvax", *{arguments!r}, "--help"]
try:
    main()
except SystemExit as stop:
    assert not stop.code, stop.code
print("heavy:", *(name for name in {HEAVY!r} if name in sys.modules))
"""
    done = run(sys.executable, "-c", code, env={**os.environ, "PYTHONPATH": str(ROOT / "src")})
    assert "Usage" in done.stdout
    return done.stdout.rpartition("heavy:")[2].strip()


@pytest.mark.parametrize("arguments", [(), ("run",), ("demo",)], ids=" ".join)
def test_help_imports_no_large_packages(arguments: tuple[str, ...]):
    # Typer itself loads pydantic, where it is installed, to look at a command's parameters.
    allowed = {"pydantic"} if arguments else set()
    assert set(help_of(*arguments).split()) <= allowed


@pytest.mark.thorough
def test_help_takes_less_than_a_second():
    code = "import sys; from dvax.app.cli import main; sys.argv = ['dvax', '--help']; main()"
    took = []
    for _ in range(5):
        start = time.perf_counter()
        run(sys.executable, "-c", code, env={**os.environ, "PYTHONPATH": str(ROOT / "src")})
        took.append(time.perf_counter() - start)
    print(f"dvax --help: best of five {min(took):.2f} s")
    assert min(took) < 1.0
