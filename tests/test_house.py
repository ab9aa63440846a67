"""Conventions of the code that no linter checks.

A class is abstract or final, and concrete methods are not overridden (equinox's own `strict` flag
checks nothing). A public name has a docstring with an example that runs.
"""

import abc
import contextlib
import doctest
import importlib
import inspect
import io
import pkgutil
import re
import runpy
from collections.abc import Iterable, Iterator
from pathlib import Path

import equinox as eqx
import pytest
from docs.extensions.public_names import public_names
from tests.figures import UNSTABLE, unstable_lines

import dvax

ROOT = Path(__file__).parents[1]

# The names that examples, tests and other people's code are written against.
CONTRACT = [
    "Problem",
    "solve",
    "solve_vi",
    "Solution",
    "Constants",
    "bound_error",
    "verify",
    "ParameterBounds",
    "parameter_bounds",
    "directional_derivative",
    "sensitivity.kinks",
    "sensitivity.change",
    "ETD1",
    "ETD2RK",
    "ETD4RK",
    "DormandPrince",
    "Event",
    "ExpRosenbrock",
    "Implicit",
    "Picard",
    "PiecewiseLinear",
    "generators.Scalar",
    "generators.Diagonal",
    "generators.Dense",
    "generators.Product",
    "generators.Zero",
    "generators.Elliptic",
    "generators.Rotation",
    "generators.Sparse",
    "generators.FiniteElements",
    "generators.KroneckerSum",
    "generators.AbstractMatrixFree",
    "operators.Scaling",
    "operators.Diagonal",
    "operators.Dense",
    "operators.Product",
    "operators.Convolution",
    "operators.LowRank",
    "operators.MatrixFree",
    "sets.Box",
    "sets.Ball",
    "sets.WholeSpace",
    "sets.Product",
    "sets.HalfSpace",
    "sets.Hyperplane",
    "sets.AffineSubspace",
    "sets.Simplex",
    "sets.SecondOrderCone",
    "sets.L1Ball",
    "sets.Ellipsoid",
    "sets.Polyhedron",
    "sets.Intersection",
    "sets.Translated",
    "sets.Scaled",
    "signals.Constant",
    "signals.Table",
    "spaces.Euclidean",
    "spaces.L2",
    "spaces.Product",
    "vi.Extragradient",
    "vi.Auto",
    "vi.Weighted",
    "vi.refute_gamma",
    "models.Circuit",
    "models.Contact",
    "models.DuvautLions",
    "models.ElasticBody",
    "models.FemContact",
    "models.Frame",
    "models.LinearMPC",
    "models.Market",
    "models.Thermostat",
    "models.Traffic",
]

ROOMS = [
    "spaces",
    "generators",
    "operators",
    "sets",
    "signals",
    "vi",
    "evolution",
    "formats",
    "models",
]


# Methods that Python or equinox calls once for every class of a family, each adding to the others.
COOPERATIVE = {"__init__", "__check_init__", "__init_subclass__"}
# What `dataclass` writes.
GENERATED = {"__repr__", "__eq__", "__hash__", "__setattr__", "__delattr__", "__replace__"}


def all_modules() -> Iterator[str]:
    for found in pkgutil.walk_packages(dvax.__path__, prefix="dvax."):
        if not found.name.endswith("__main__"):
            yield found.name


def family(root: type = eqx.Module) -> list[type]:
    """Every subclass of `root` in dvax, with all its modules imported."""
    for name in all_modules():
        importlib.import_module(name)
    seen: dict[type, None] = {}
    waiting = [root]
    while waiting:
        for cls in waiting.pop().__subclasses__():
            if cls not in seen:
                seen[cls] = None
                waiting.append(cls)
    ours = [cls for cls in seen if cls.__module__.split(".")[0] == "dvax"]
    return sorted(ours, key=lambda cls: (cls.__module__, cls.__qualname__))


def title(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def abstract_members(cls: type) -> set[str]:
    return set().union(
        getattr(cls, "__abstractmethods__", ()),
        getattr(cls, "__abstractvars__", ()),
        getattr(cls, "__abstractclassvars__", ()),
    )


def behaviour(cls: type) -> dict[str, object]:
    """The methods and properties that `cls` itself defines."""
    kinds = (property, classmethod, staticmethod)
    return {
        name: member
        for name, member in vars(cls).items()
        if (callable(member) or isinstance(member, kinds))
        and not isinstance(member, type)
        and name not in COOPERATIVE | GENERATED
    }


def faults_of(classes: Iterable[type]) -> list[str]:
    """Violations of 'abstract or final, and no concrete method is overridden', as sentences."""
    classes = list(classes)
    faults = []
    for cls in classes:
        name, members = cls.__name__, abstract_members(cls)
        promises = name.lstrip("_").startswith("Abstract")
        if promises and not members:
            faults.append(f"{title(cls)} is named Abstract and promises nothing")
        if members and not promises:
            faults.append(f"{title(cls)} leaves {sorted(members)} open and is not named Abstract")
        for base in cls.__mro__[1:]:
            if base not in classes:
                continue
            if not abstract_members(base):
                faults.append(f"{title(cls)} extends {title(base)}, which is final")
            for method in sorted(set(behaviour(cls)) & set(behaviour(base))):
                if not getattr(behaviour(base)[method], "__isabstractmethod__", False):
                    faults.append(f"{title(cls)}.{method} overrides that of {title(base)}")
    return faults


def public(room: str) -> dict[str, object]:
    """The classes and functions of dvax that the `__init__` of a folder exports."""
    module = importlib.import_module(f"dvax.{room}")
    # Some are loaded when they are first asked for.
    offered = {name: getattr(module, name) for name in getattr(module, "__all__", vars(module))}
    return {
        f"{room}.{name}": thing
        for name, thing in offered.items()
        if not name.startswith("_")
        and (inspect.isclass(thing) or inspect.isfunction(thing))
        and getattr(thing, "__module__", "").split(".")[0] == "dvax"
    }


def resolve(name: str) -> object:
    thing: object = dvax
    for part in name.split("."):
        thing = getattr(thing, part)
    return thing


def test_classes_are_abstract_or_final():
    classes = family()
    assert len(classes) > 10
    faults = faults_of(classes)
    assert not faults, "\n".join(faults)


def test_class_faults_are_detected():
    class AbstractShape(eqx.Module):
        @abc.abstractmethod
        def area(self) -> float: ...

        def twice(self) -> float:
            return 2 * self.area()

    class Disc(AbstractShape):
        def area(self) -> float:
            return 3.0

    class Ring(Disc):
        def area(self) -> float:
            return 2.0

    class Loud(AbstractShape):
        def area(self) -> float:
            return 1.0

        def twice(self) -> float:
            return 5.0

    class AbstractNothing(eqx.Module):
        pass

    class Unfinished(AbstractShape):
        pass

    def short(*classes: type) -> list[str]:
        prefix = f"{__name__}.{test_class_faults_are_detected.__qualname__}.<locals>."
        return [fault.replace(prefix, "") for fault in faults_of(classes)]

    assert short(AbstractShape, Disc) == []
    assert short(AbstractShape, Disc, Ring) == [
        "Ring extends Disc, which is final",
        "Ring.area overrides that of Disc",
    ]
    assert short(AbstractShape, Loud) == ["Loud.twice overrides that of AbstractShape"]
    assert short(AbstractNothing) == ["AbstractNothing is named Abstract and promises nothing"]
    assert short(AbstractShape, Unfinished) == [
        "Unfinished leaves ['area'] open and is not named Abstract"
    ]


# Needs several devices; tests/sharded runs it in a process of its own.
NOT_RUN_HERE = {"communication"}


def test_contract_names_are_public():
    assert not set(CONTRACT) - {name.removeprefix("dvax.") for name in public_names()}


# Examples whose programs take long to compile.
LONG = set(
    """
    Bound DifferentiationError Directional Ensemble Event Fold Implicit SolveError ZarrStore bound_error
    directional_derivative ensemble ensembles.Moments evolution.Bounds evolution.Events
    evolution.Exported evolution.ExportedSolution export load_exported models.DruckerPrager
    models.DuvautLions models.FemContact models.Frame models.Thermostat models.VonMises
    models.response_spectrum sensitivity.Change sensitivity.Kink sensitivity.change sensitivity.kinks
    vi.Counterexample vi.refute_gamma
    """.split()
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.thorough] if name in LONG else [])
        for name in (name.removeprefix("dvax.") for name in public_names())
    ],
)
def test_public_names_have_an_example_that_runs(name: str):
    thing = resolve(name)
    if name in NOT_RUN_HERE:
        assert ">>>" in (inspect.getdoc(thing) or "")
        return
    finder = doctest.DocTestFinder(recurse=False)
    found = finder.find(thing, name, module=False, globs={})
    examples = [example for test in found for example in test.examples]
    assert any(example.want for example in examples), f"the docstring of {name} shows no result"
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    for test in found:
        runner.run(test, out=report.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(report)


def test_readme_example_prints_the_documented_output(tmp_path: Path):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    examples = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", text, flags=re.DOTALL)
    assert len(examples) == text.count("```python") == 1
    script = tmp_path / "example.py"
    script.write_text(examples[0][0], encoding="utf-8")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        runpy.run_path(str(script))
    assert printed.getvalue() == examples[0][1]


@pytest.mark.parametrize("room", ROOMS)
def test_public_names_are_documented(room: str):
    names = public(room)
    assert names
    bare = [
        name
        for name, thing in names.items()
        # A dataclass without a docstring is given its own signature as one.
        if not (text := inspect.getdoc(thing)) or text.startswith(f"{name.rpartition('.')[2]}(")
    ]
    assert not bare, f"no docstring: {bare}"


def test_architecture_page_names_existing_files():
    page = (ROOT / "docs" / "architecture.md").read_text()
    named = set(re.findall(r"[\w/]+\.py\b", page)) | set(re.findall(r"`([\w/]+/)`", page))
    assert len(named) > 20
    homes = [ROOT / "src" / "dvax", ROOT / "src" / "dvax" / "evolution", ROOT]
    absent = [name for name in sorted(named) if not any((home / name).exists() for home in homes)]
    assert not absent


@pytest.mark.slow
def test_unstable_jax_interfaces_are_used_in_one_folder_only():
    assert list(unstable_lines()) == []
    # The reader finds what it looks for.
    assert UNSTABLE.search("from jax.interpreters import mlir")
    assert UNSTABLE.search("jax.experimental.xla_metadata")
