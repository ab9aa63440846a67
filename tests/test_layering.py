"""The layers: a folder imports only from floors below its own, without cycles.

The imports are read from the sources, those inside functions and under TYPE_CHECKING included: a
dependence that is only a type is still a dependence.
"""

import ast
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "dvax"

FLOORS = {
    "errors": -2,
    "_lazy": -2,
    "_version": -2,
    "_files": -2,
    "_tree": -1,
    "_batch": -1,
    "_lookup": -1,
    "_small_matrices": -1,
    "_failure": -1,
    "_once": -2,
    "_captured": 0,
    "_jax": -1,
    "programs": -0.5,
    "_user_code": 0,
    "_figure_text": -2,
    "_dataset": -0.5,
    "_repr": -1,
    "spaces": 0,
    "generators": 0,
    "operators": 0,
    "sets": 0,
    "signals": 0,
    "_control_shape": 1,
    "formats": 1,
    "vi": 1,
    "_knots": 1.5,
    "problem": 2,
    "evolution": 3,
    "ensembles": 3.5,
    "theory": 4,
    "sensitivity": 4,
    "models": 5,
    # The public names: `import dvax` is for those who live above the library.
    "": 5.5,
    "app": 6,
    "__main__": 7,
}

# Two rooms on one floor where one may look into the other, and why. Each pair must be in use.
NEIGHBOURS = {
    ("generators", "spaces"): "a growth bound ‖e^{At}‖ ≤ M e^{ωt} is a bound in a space's norm",
    ("operators", "spaces"): "self-adjoint and coercive are meant in a space's inner product",
    ("sets", "spaces"): "a projection is nearest in a space's norm",
    ("sensitivity", "theory"): "what a derivative predicts is shown beside what is certified",
}

CORE = {"jax", "equinox", "diffrax", "numpy", "optimistix", "scipy"}
APPLICATION = {
    *("dask", "distributed", "h5netcdf", "h5py", "matplotlib", "numcodecs", "pint", "plotly"),
    *("pydantic", "pydantic_core", "rich", "tomli_w", "typer", "xarray", "zarr"),
}
# Extras that a function asks for when it is called, and says so where they are missing.
EXTRAS = {"clarabel", "flatbuffers", "meshio", "pyarrow", "skfem"}
# What the command line may load before it knows what is asked of it.
LIGHT = {"typer", "rich"}
COMMAND_LINE = "dvax.app.cli"


class Import(NamedTuple):
    importer: str  # dotted module
    line: int
    imported: str  # dotted module, as deep as it is one
    deferred: bool  # not run when the module is loaded: inside a function, or for types alone


def modules(package: Path) -> dict[str, Path]:
    """Dotted name → file, for every module of `package`."""
    found = {}
    for file in sorted(package.rglob("*.py")):
        parts = [package.name, *file.relative_to(package).with_suffix("").parts]
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


def imports(package: Path) -> list[Import]:
    """Every import statement of `package`, relative ones resolved."""
    known = modules(package)
    result = []
    for name, file in known.items():
        tree = ast.parse(file.read_text(encoding="utf-8"), filename=str(file))
        deferred = {
            id(inner)
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) or for_types(node)
            for inner in ast.walk(node)
        }
        home = name if file.name == "__init__.py" else name.rpartition(".")[0]
        for node in ast.walk(tree):
            targets: list[str] = []
            if isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = node.module or ""
                if node.level:
                    parts = home.split(".")
                    above = ".".join(parts[: len(parts) - node.level + 1])
                    base = f"{above}.{base}" if base else above
                # `from package import x` imports x if it is a module, else the package.
                targets = [
                    f"{base}.{alias.name}" if f"{base}.{alias.name}" in known else base
                    for alias in node.names
                ]
            for target in targets:
                result.append(
                    Import(name, getattr(node, "lineno", 0), target, id(node) in deferred)
                )
    return result


UPWARD = {
    # `Solution.regimes` runs the solve again where it did not record its steps.
    ("dvax.evolution.solution", "dvax.evolution.solve"),
    # `Solution.plot`: pictures belong to the application.
    ("dvax.evolution.solution", "dvax.app.plots.solution"),
    ("dvax.ensembles.result", "dvax.app.plots.ensemble"),
}
"""Imports inside functions that may close a cycle, or go to a higher floor."""


def room(module: str) -> str:
    """'dvax.sets.box' → 'sets'; 'dvax' → ''."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


def wrong_floors(package: Path) -> tuple[list[str], set[tuple[str, str]]]:
    """Imports that do not go to a lower floor, as sentences, and the allowed neighbours in use."""
    wrong, used = [], set()
    for importer, line, imported, _ in imports(package):
        if imported.split(".")[0] != package.name:
            continue
        here, there = room(importer), room(imported)
        if here == there or here == "":  # the package's own __init__ only lists names
            continue
        if (importer, imported) in UPWARD:
            continue
        if (here, there) in NEIGHBOURS:
            used.add((here, there))
        elif FLOORS[there] >= FLOORS[here]:
            floors = f"floor {FLOORS[here]} imports from floor {FLOORS[there]}"
            wrong.append(f"{importer}:{line} imports {imported}: {floors}")
    return wrong, used


def circle(graph: dict[str, set[str]]) -> list[str]:
    """The nodes of one cycle of `graph`, in order; empty if there is none."""
    done: set[str] = set()

    def descend(node: str, path: list[str]) -> list[str]:
        if node in path:
            return [*path[path.index(node) :], node]
        if node not in done:
            for child in sorted(graph.get(node, ())):
                if found := descend(child, [*path, node]):
                    return found
            done.add(node)
        return []

    for start in sorted(graph):
        if found := descend(start, []):
            return found
    return []


def dependence(package: Path, of: str) -> dict[str, set[str]]:
    """The imports inside `package`, between 'modules' or between 'rooms'."""
    graph: dict[str, set[str]] = {}
    for importer, _, imported, _ in imports(package):
        if (importer, imported) in UPWARD:
            continue
        if imported.split(".")[0] == package.name and importer != package.name:
            a, b = (importer, imported) if of == "modules" else (room(importer), room(imported))
            if of == "modules" or a != b:
                graph.setdefault(a, set()).add(b)
    return graph


def foreign(package: Path) -> list[str]:
    """Imports of packages that the importing folder may not use, as sentences."""
    wrong = []
    for importer, line, imported, deferred in imports(package):
        top = imported.split(".")[0]
        if top in {package.name, "__future__"} or top in sys.stdlib_module_names:
            continue
        here = room(importer)
        at_start = here == "" or importer in {"dvax.app", COMMAND_LINE}
        if (at_start or importer.startswith(COMMAND_LINE + ".")) and not deferred:
            # The package's __init__ is loaded by the command line too.
            allowed, why = LIGHT, "the command line loads it at its start"
        elif here == "app" or deferred:
            allowed, why = CORE | APPLICATION | EXTRAS, "it is not a declared dependency"
        else:
            allowed, why = CORE, "the library below the application needs the JAX stack alone"
        if top not in allowed:
            wrong.append(f"{importer}:{line} imports {top}: {why}")
    return wrong


def test_folders_have_a_floor():
    assert {room(name) for name in modules(SOURCE)} <= set(FLOORS)


def test_imports_go_to_lower_floors_only():
    wrong, _ = wrong_floors(SOURCE)
    assert not wrong, "\n".join(wrong)


def test_import_exceptions_are_in_use():
    _, used = wrong_floors(SOURCE)
    assert used == set(NEIGHBOURS)


def test_upward_imports_are_in_use_and_deferred():
    found = {(importer, imported): deferred for importer, _, imported, deferred in imports(SOURCE)}
    assert all(found.get(pair) for pair in UPWARD)


@pytest.mark.parametrize("of", ["modules", "rooms"])
def test_imports_have_no_cycles(of: str):
    assert circle(dependence(SOURCE, of)) == []


def test_third_party_imports_are_declared_and_restricted_to_their_folders():
    wrong = foreign(SOURCE)
    assert not wrong, "\n".join(wrong)


def plant(folder: Path, **files: str) -> Path:
    """Create a small package named dvax with the given files, '__' standing for '/'."""
    package = folder / "dvax"
    for name, text in {"__init__": "", **files}.items():
        file = package / ("__init__.py" if name == "__init__" else name.replace("__", "/") + ".py")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    return package


@pytest.mark.parametrize(
    "text",
    [
        "from dvax.evolution import solve",
        "from ..evolution import solve",
        "from .. import evolution",
        "import dvax.evolution.solve",
        "import dvax",
        "def late():\n    from ..evolution import solve",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ..evolution import solve",
        "from ..generators.scalar import Scalar",
    ],
)
def test_import_upward_or_sideways_is_detected(tmp_path: Path, text: str):
    house = plant(tmp_path, sets__box=text, evolution__solve="", generators__scalar="")
    (house / "evolution" / "__init__.py").touch()
    wrong, _ = wrong_floors(house)
    assert len(wrong) == 1 and wrong[0].startswith("dvax.sets.box:")


def test_import_downward_is_not_reported(tmp_path: Path):
    house = plant(tmp_path, vi__residual="from ..sets.box import Box", sets__box="import jax")
    assert wrong_floors(house) == ([], set())
    assert foreign(house) == []


def test_import_cycle_is_detected(tmp_path: Path):
    house = plant(
        tmp_path,
        sets__box="from .ball import Ball",
        sets__ball="from .space import WholeSpace",
        sets__space="def late():\n    from .box import Box",
    )
    assert set(circle(dependence(house, "modules"))) == {
        "dvax.sets.ball",
        "dvax.sets.box",
        "dvax.sets.space",
    }
    other = plant(tmp_path / "b", sets__a="from ..signals import b", signals__b="import dvax.sets")
    assert set(circle(dependence(other, "rooms"))) == {"sets", "signals"}


def test_undeclared_third_party_import_is_detected(tmp_path: Path):
    house = plant(
        tmp_path,
        sets__box="import xarray",
        app__runs__store="import requests",
        app__cli__program="import jax",
        evolution__solution="def to_xarray():\n    import xarray",
        evolution__stepper="if typing.TYPE_CHECKING:\n    import xarray",
    )
    assert sorted(line.split(":")[0] for line in foreign(house)) == [
        "dvax.app.cli.program",
        "dvax.app.runs.store",
        "dvax.sets.box",
    ]


@pytest.mark.slow
def test_a_plain_solve_and_its_bound_import_neither_scipy_nor_diffrax() -> None:
    """They are slow to import, and few runs need them."""
    code = (
        "import sys, dvax, jax\n"
        "jax.config.update('jax_enable_x64', True)\n"
        "problem = dvax.Problem(\n"
        "    A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),\n"
        "    K=dvax.sets.Box(0.0, 0.5), f=lambda t, x, u, args: 3.0 - 0.5 * x - u,\n"
        "    h=lambda t, x, u, args: 1.0 - 2.0 * x - u,\n"
        ")\n"
        "sol = dvax.solve(problem, -1.0, 0.0, 2.0)\n"
        "bound = dvax.bound_error(problem, sol, dvax.verify(problem, -1.0, 0.0, 2.0).constants)\n"
        "slow = [name for name in ('scipy', 'diffrax', 'optimistix') if name in sys.modules]\n"
        "print(float(bound.x[0]) < 1e-3, slow)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.stdout.split("\n")[0] == "True []", done.stdout + done.stderr
