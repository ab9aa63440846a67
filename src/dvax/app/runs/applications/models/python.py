"""`[model] python = "file.py:build"`: a problem of the user's own."""

import importlib.util
import inspect
import math
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal, get_type_hints

import jax.tree_util as jtu
import numpy as np
from pydantic import Field, PlainValidator, model_validator

from dvax.app.runs.applications.base import Figure, Variable
from dvax.app.runs.applications.certificate import Certificate, along
from dvax.app.runs.applications.from_model import AbstractModelApplication, FramesKeys
from dvax.app.runs.applications.own_parameters import PREFIX, Parameters, complete, unit_of
from dvax.app.runs.schema import rule_error
from dvax.app.runs.units import converted
from dvax.errors import DvaxError, InputError, Problems, input_error
from dvax.evolution import Solution
from dvax.models import Model
from dvax.theory.along import BoundAlong
from dvax.theory.energy import MAX_UNKNOWNS
from dvax.theory.local_derivatives import MAX_UNKNOWNS as MAX_UNKNOWNS_ALONG

_REMEDY_ALONG = (
    "A larger bound_steps in [model] follows the trajectory further, a smaller rtol makes the bound "
    "smaller: docs/models/own-problem.md says how."
)

_REMEDY_NOT_PROVED = (
    "If you know it, pass constants=dvax.verify(…, declared={…}).constants to dvax.models.Model: "
    "docs/howto/troubleshooting.md shows how."
)

_REMEDY_NOT_FOLLOWED = (
    "bound_steps = 0 in [model] asks for a bound by constants. Leave it out for one that is proved "
    "along the trajectory."
)


def _number_or_text(value: Any) -> float | str | None:
    """Check the end of a run, whose unit is known when the model is built."""
    if type(value) in (int, float) and math.isfinite(value):
        return float(value)
    if value is None or isinstance(value, str):
        return value
    raise rule_error(
        "it is a finite number, or a text with a number and a unit of time", 'Write "2.5 h", say'
    )


class PythonSection(FramesKeys):
    """The function that builds the model, its parameters, and how long to run it."""

    name: Literal["python"] = Field("python", description="the model")
    python: str = Field(description="Python file, and the function in it that builds the model")
    function: str = Field(
        "build", description="the function, which may stand behind the file: a.py:build"
    )
    parameters: dict[str, Any] = Field(
        default_factory=dict, description="the arguments of that function"
    )
    t_end: Annotated[float | str | None, PlainValidator(_number_or_text)] = Field(
        None,
        description="end of the run, by default that of the model; a text such as '2 h' is converted "
        "to its unit of time",
    )
    certify: bool = Field(
        False,
        description="choose steps whose defect can be enclosed, and not the fastest ones; "
        "they can be orders of magnitude more",
    )
    energy: bool = Field(
        False, description="search for a norm in which the error bound grows more slowly"
    )
    bound_steps: int = Field(
        1_000_000,
        ge=0,
        description="largest number of steps of the trajectory along which the error bound is proved; "
        "0: by constants for the whole space",
    )

    @model_validator(mode="before")
    @classmethod
    def _split(cls, given: Any) -> Any:
        if isinstance(given, dict) and isinstance(given.get("python"), str):
            file, _, function = given["python"].rpartition(":")
            if file and function.isidentifier():
                return {**given, "python": file, "function": function}
        return given


class PythonApplication(AbstractModelApplication):
    """States and responses over time, by the names that the model gives them."""

    section = PythonSection
    files = ("python",)
    is_checked_in_part = True
    end = "model.t_end"

    def __init__(self, table: PythonSection, paths: Mapping[str, Path], quiet: bool):
        self.file = paths["python"]
        build, hints = _function(self.file, table.function)
        self.units = {name: unit for name in hints if (unit := unit_of(hints[name])) is not None}
        parameters, problems = _run(self.file, lambda: Parameters(build, hints)), Problems()
        made = _run(self.file, lambda: parameters.in_part(table.parameters))
        with problems.collect():
            made = _run(self.file, lambda: parameters.validated(table.parameters))
        if made is None or set(parameters.files(made, table.parameters)) - set(paths):
            # The caller reports files that are missing.
            raise InputError(*problems)
        located = {key: path for key, path in paths.items() if key.startswith(PREFIX)}
        self.table = table.model_copy(update={"parameters": complete(made)})
        try:
            arguments = parameters.arguments(made, located)
            model = _built(self.file, table.function, lambda: build(**arguments))
        except InputError as error:
            # With wrong parameters only the problems are of interest that do not depend on them.
            problems.raise_any()
            raise _with_parameters(error, table.parameters) from error
        self.certified, self.place_of_figures = table.certify, f"{self.file.name}: figures"
        may_use_energy = not table.energy and _unknowns(model) <= MAX_UNKNOWNS
        self.energy, self.remedy = table.energy, _remedy(may_use_energy)
        by_constants = model.constants is not None or table.certify or table.energy
        is_small = _unknowns(model) <= MAX_UNKNOWNS_ALONG
        self.is_followed = not by_constants and table.bound_steps > 0 and is_small
        self.follower: BoundAlong | str = ""
        if self.is_followed:
            self.remedy = _REMEDY_ALONG
        elif not by_constants and is_small:
            self.remedy = f"{_REMEDY_NOT_FOLLOWED} {self.remedy}"
        self.whole, self.bound_unit = model.figures is not None, _bound_unit(model)
        if table.energy:
            with problems.collect():
                _check_energy(model)
        with problems.collect():
            self.set_model(model, _end(model, table.t_end))
        problems.raise_any()

    @classmethod
    def further_files(cls, table: PythonSection, paths: Mapping[str, Path]) -> Mapping[str, str]:
        """Return the values of the parameters whose type is `pathlib.Path`."""
        file = paths["python"]
        build, hints = _function(file, table.function)
        parameters = _run(file, lambda: Parameters(build, hints))
        made = _run(file, lambda: parameters.in_part(table.parameters))
        return {} if made is None else parameters.files(made, table.parameters)

    @property
    def label(self) -> str:
        return self.table.function

    @property
    def fit(self) -> str:
        return f"a problem of your own: {self.file.name}"

    def call(self, work: Callable[[], Any]) -> Any:
        return _run(self.file, work)

    def notes(self) -> tuple[str, ...]:
        said = [f"The code of {self.file.name}:{self.table.function} is executed."]
        if self.energy and self.constants is not None and self.constants.energy is None:
            said.append(
                "energy = true has found no norm, and the error bound uses that of the state space: "
                f"{self.verification.no_energy}."
            )
        return tuple(said)

    def _note_on_bound(self) -> tuple[str, ...]:
        # Along the trajectory errors grow less than by these constants.
        return () if self.is_followed else super()._note_on_bound()

    def _bound(self, piece: Solution, before: Certificate | None) -> Certificate | None:
        if not self.is_followed:
            return super()._bound(piece, before)
        if before is None:
            steps = self.table.bound_steps
            try:
                self.follower = BoundAlong(
                    self.own.problem, piece, self.times, self.t_end, max_steps=steps
                )
            except InputError as error:
                self.follower, self.remedy = error.problems[0].rule, _REMEDY_NOT_PROVED
        if isinstance(self.follower, BoundAlong):
            return along(self.follower, piece, before)
        return Certificate(np.full(len(piece.ts), np.inf), "estimated", why=self.follower)

    def series(self, solution: Solution, bound: Certificate | None) -> Mapping[str, Variable]:
        return {**self.named(solution), **self.bound_series(bound)}

    def figures(
        self, series: Mapping[str, np.ndarray], end: Solution, bound: Certificate | None
    ) -> Mapping[str, Figure]:
        of = self.own.figures
        found = {} if of is None else _run(self.file, lambda: dict(of(end)))
        own = {n: Figure(*_figure(self.file, n, entry)) for n, entry in found.items()}
        return self.joined(self.final_values(end) | self.bound_figure(bound), own)


def _end(model: Model, t_end: float | str | None) -> float | None:
    """Return the end of the run in the unit of time of the model."""
    if not isinstance(t_end, str):
        return t_end
    unit = model.time_unit
    number = converted(t_end, unit) if unit else None
    if number is None:
        rule = f"it is a number in {unit}, or a text with a number and a unit of time"
        without = "time has no unit in this model (time_unit= of dvax.models.Model)"
        fix = f'Write "2.5 {unit}"' if unit else "Write a number without quotes"
        raise input_error("model.t_end", repr(t_end), rule if unit else without, fix)
    return number


def _built(file: Path, function: str, build: Callable[[], Any]) -> Model:
    """Return the model that a function in a file builds, its problem checked."""
    model = _run(file, build)
    if not isinstance(model, Model):
        raise input_error(
            f"{file.name}: {function}", type(model).__name__,
            "it must return a dvax.models.Model",
            "Write return dvax.models.Model(problem, x0, t_end)",
        )  # fmt: skip
    _run(file, lambda: model.problem.check(model.t0, model.x0, model.args))
    return model


def _with_parameters(error: InputError, given: Mapping[str, Any]) -> InputError:
    """Return an error of the user's code with the parameters that are given, one of which may be its
    cause."""
    listed = ", ".join(f"{name} = {value!r}" for name, value in given.items())
    if not listed:
        return error
    told = f"[model.parameters] has {listed}"[:300]
    return InputError(*(replace(p, fix=f"{p.fix}. {told}") for p in error.problems))


def _unknowns(model: Model) -> int:
    """Return the number of entries of x and u."""
    both = model.x0, model.problem.zero_control(model.x0)
    return sum(np.size(leaf) for leaf in jtu.tree_leaves(both))


def _remedy(may_use_energy: bool) -> str:
    """Return what to try for a smaller bound."""
    linear = "energy = true in [model] if f and h are affine, " if may_use_energy else ""
    return (
        f"Try {linear}constants of a region in the Python file, weights of the state space, or a "
        "shorter run: docs/howto/troubleshooting.md shows how."
    )


def _bound_unit(model: Model) -> str:
    """Return the unit of a norm of the state: that of all states if their weights are 1, else "", since
    weights may have units."""
    units = set(model.states.values())
    weights = jtu.tree_leaves(model.problem.spaces(model.x0)[0].weights())
    return units.pop() if len(units) == 1 and all(np.all(w == 1) for w in weights) else ""


def _check_energy(model: Model) -> None:
    """Raise an `InputError` if no norm can be searched for."""
    if model.constants is not None:
        raise input_error(
            "model.energy", "true", "the model declares its constants, and nothing is searched for",
            "Leave energy out, or constants= of dvax.models.Model",
        )  # fmt: skip
    if importlib.util.find_spec("clarabel") is None:
        raise input_error(
            "model.energy", "true",
            "the norm is found by a semidefinite program, which Clarabel solves",
            "Install it with pip install 'dvax[energy]', or leave energy out",
        )  # fmt: skip


def _figure(file: Path, name: str, entry: Any) -> tuple[Any, str, str]:
    if not (isinstance(entry, tuple) and len(entry) == 3):
        raise input_error(
            f"{file.name}: figures", repr(entry)[:70], f"{name!r} is (value, unit, meaning)",
            'Write {"largest force": (3.0, "N", "over the run")}',
        )  # fmt: skip
    value, unit, meaning = entry
    number = _run(file, lambda: np.asarray(value, float))
    return number.tolist(), str(unit), str(meaning)


def _function(file: Path, name: str) -> tuple[Callable[..., Any], dict[str, Any]]:
    """Import a file, and return its function of that name with the types of its parameters."""
    module = _run(file, lambda: _import(file))
    found = getattr(module, name, None)
    if not callable(found):
        known = [
            n
            for n, v in vars(module).items()
            if inspect.isfunction(v) and v.__module__ == module.__name__
        ]
        raise input_error(
            "model.python", f"{file.name}:{name}", f"{file.name} has no function {name!r}",
            f"It has {', '.join(known)}" if known else f"Write def {name}(...) in it",
        )  # fmt: skip
    # Python 3.14 evaluates the types here, and not when it imports the file.
    return found, _run(file, lambda: get_type_hints(found, include_extras=True))


_imported: dict[Path, tuple[bytes, ModuleType]] = {}


def _import(file: Path) -> ModuleType:
    """Return the module of a file, made once for its content: then runs with other parameters have the
    same functions, and with them the same compiled programs."""
    content = file.read_bytes()
    if file in _imported and _imported[file][0] == content:
        return _imported[file][1]
    # Beside it may lie modules that it imports.
    folder = str(file.parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    name = f"dvax_own_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise input_error(
            "model.python", repr(file.name), "it must be a Python file", "Name it *.py"
        )
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    _imported[file] = content, module
    return module


def _run(file: Path, work: Callable[[], Any]) -> Any:
    """Return work(), code of the user.

    **Raises:** `dvax.InputError` that names the line in `file` where an exception comes from.
    """
    try:
        return work()
    except InputError as error:
        place = _line(file, error)
        # Of several problems that were collected each has a line of its own.
        if place == file.name or (error.__cause__ is not None and len(error.problems) > 1):
            raise
        raise InputError(
            *(
                replace(
                    p,
                    place=p.place.replace(str(file), file.name)
                    if str(file) in p.place
                    else f"{place}: {p.place}",
                )
                for p in error.problems
            )
        ) from error
    except DvaxError:
        raise
    except SyntaxError as error:
        raise input_error(
            _line(file, error), f"{(error.text or '').strip()[:200]}",
            f"the file must be valid Python: {error.msg}", "Correct that line",
        ) from error  # fmt: skip
    except Exception as error:
        raise input_error(
            _line(file, error), f"{type(error).__name__}: {error}"[:300],
            "the file must run without an exception",
            "Fix that line; --debug shows the traceback",
        ) from error  # fmt: skip


def _line(file: Path, error: Exception) -> str:
    """Return the file, with the last line in it that an exception or its cause passed through, if there
    is one."""
    lines: list[int | None] = []
    found: BaseException | None = error
    while found is not None and not lines:
        frames = traceback.extract_tb(found.__traceback__)
        lines += [frame.lineno for frame in frames if frame.filename == str(file)]
        if isinstance(found, SyntaxError) and found.lineno:
            lines.append(found.lineno)
        found = found.__cause__
    return f"{file.name}, line {lines[-1]}" if lines else file.name


APPLICATION = PythonApplication
