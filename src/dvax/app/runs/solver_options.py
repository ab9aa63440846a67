"""The options of the solver as keys of a configuration, for every model."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, Field, ValidationInfo

from dvax import evolution, vi
from dvax.app.runs.schema import (
    MOST_COUNTED,
    Section,
    SolverSection,
    ViSolver,
    broken,
    within_precision,
)
from dvax.errors import Fix, InputError, InputProblem, input_error
from dvax.evolution.arguments import ADAPTIVE_STEPS

MOST_STEPS = 2**30
"""The most fixed steps of a run."""
SEGMENTS = 100
"""Solves that the run of an application consists of, where it has times enough."""

Method = Literal[
    "ETD1", "ETD2RK", "ETD4RK", "ExpRosenbrock", "DormandPrince", "Implicit", "PiecewiseLinear"
]  # fmt: skip


def alone(dt: float | None, info: ValidationInfo) -> float | None:
    """Fixed steps have no tolerance, and adapt to none."""
    given = [name for name in ("rtol", "atol", "dt_max") if info.data.get(name) is not None]
    if dt is not None and given:
        raise broken(
            f"steps are fixed by dt, or chosen for {' and '.join(given)}, not both",
            f"Leave out dt, or {' and '.join(given)}",
        )
    if dt is not None and info.data.get("method") == "Implicit":
        raise broken("the steps of an implicit method are chosen for rtol and atol", "Leave out dt")
    return dt


def _apart(value: Any, info: ValidationInfo) -> Any:
    """`PiecewiseLinear` steps from event to event, and knows its law in closed form."""
    if value is not None and info.data.get("method") == "PiecewiseLinear":
        raise broken(
            "PiecewiseLinear steps from one change of the constraints to the next, and solves its law "
            "in closed form",
            f"Leave out {info.field_name}, or name another method",
        )
    return value


class SolverKeys(Section):
    """Keys that go to `dvax.solve`; one that is left out has the default of the model."""

    method: Method | None = Field(None, description="of a step; by default that of the model")
    rtol: Annotated[float | None, AfterValidator(within_precision)] = Field(
        None, gt=0, lt=1, description="relative tolerance of a run"
    )
    atol: float | None = Field(None, gt=0, description="absolute tolerance, in units of the state")
    dt_max: Annotated[float | None, AfterValidator(_apart)] = Field(
        None, gt=0, description="the longest step that adapts, in units of time"
    )
    dt: Annotated[float | None, AfterValidator(_apart), AfterValidator(alone)] = Field(
        None, gt=0, description="fixed steps of this length, in the place of rtol and atol"
    )
    max_steps: int | None = Field(
        None, ge=1, le=MOST_COUNTED, description="the most steps between two blocks of frames"
    )
    vi_solver: Annotated[ViSolver | None, AfterValidator(_apart)] = Field(
        None, description="of the frozen law; by default that of the model"
    )


def check_steps(table: SolverKeys, span: float, words: str) -> None:
    """Raise an `InputError` where a fixed step is longer than the run, which has the length `span` (in
    `words`), or so short that steps cannot be counted."""
    for key, step in (("dt", table.dt), ("dt_max", table.dt_max)):
        if step is None or (step <= span and span / step < MOST_STEPS):
            continue
        rule = (
            f"a step is not longer than the run, which has {words}"
            if step > span
            else f"a run has fewer than {MOST_STEPS} steps, or they cannot be counted"
        )
        fix = f"Write {key} = {span / 100:.3g}, say, or leave it out"
        raise input_error(f"model.{key}", f"{step:g}", rule, fix)
    # Of at most a hundred segments, one is at least this long.
    problem = short_dt_max(table.dt_max, table.max_steps, span / SEGMENTS, "model")
    if problem is not None:
        raise InputError(problem)


def short_dt_max(
    dt_max: float | None, max_steps: int | None, span: float, table: str
) -> InputProblem | None:
    """What is wrong with a `dt_max` so short that one solve, over a time of `span`, takes more than
    `max_steps` steps."""
    most = ADAPTIVE_STEPS if max_steps is None else max_steps
    if dt_max is None or span <= most * dt_max:
        return None
    return InputProblem(
        f"{table}.dt_max",
        f"{dt_max:g}",
        f"between two blocks of frames, {span:.3g} apart, steps no longer than that are more than "
        f"max_steps = {most}",
        f"Write dt_max = {_rounded_up(span / most)} or more, or a larger max_steps",
    )


def _rounded_up(number: float) -> str:
    """The number with two digits, rounded up."""
    shown = f"{number:.1e}"
    return shown if float(shown) >= number else f"{1.05 * number:.1e}"


def event_driven(table: SolverKeys) -> bool:
    """Whether a model that `dvax.PiecewiseLinear` can solve is solved by it: where the file names no
    method, and no option of those that take steps."""
    return all(value is None for value in (table.method, table.dt, table.dt_max, table.vi_solver))


def settings(table: SolverKeys, **defaults: Any) -> dict[str, Any]:
    """The keywords for `dvax.solve`: the keys that are given, else the defaults of the model."""
    given: dict[str, Any] = {
        name: value
        for name in ("rtol", "atol", "dt", "dt_max", "max_steps")
        if (value := getattr(table, name)) is not None
    }
    if table.method is not None:
        given["method"] = getattr(evolution, table.method)()
    if table.vi_solver is not None:
        given["vi_solver"] = getattr(vi, table.vi_solver)()
    # Steps are fixed or adapt: what the file says of one kind drops the defaults of the other.
    adaptive = ("rtol", "atol", "dt_max")
    dropped = {"dt": adaptive, **dict.fromkeys(adaptive, ("dt",))}
    out = [other for name in given for other in dropped.get(name, ())]
    return {k: v for k, v in defaults.items() if k not in out} | given


def in_keys_of(section: type[Section], table: str, end: str | None = None) -> Any:
    """How a `Fix` reads in a configuration whose solver's keys stand in `[table]`; `end` is the key of
    the last time. None for an option that the file does not have."""

    def phrase(fix: Fix) -> str | None:
        if not fix.option:
            return fix.why
        key = end if fix.option == "t1" else f"{table}.{fix.option}"
        if key is None or (fix.option != "t1" and fix.option not in section.model_fields):
            return None
        known = get_args(Method) + get_args(ViSolver)
        value = f'"{fix.value}"' if fix.value in known else fix.value
        return f"Write {key} = {value}, {fix.why}"

    return phrase


_OF_SOLVE = re.compile(r"dvax\.solve\(([^()]*)\)")
_ELSEWHERE = {
    "t0": "time",
    "t1": "time.end",
    "t0, t1": "time.end",
    "ts": "time.frames",
    "x0": "initial",
}


@contextmanager
def in_solver_keys(file: str) -> Iterator[None]:
    """Problems that `dvax.solve` finds in its arguments name the keys of the contact law's `file`."""
    try:
        yield
    except InputError as error:
        raise InputError(*(_with_keys(problem, file) for problem in error.problems)) from error


def _with_keys(problem: InputProblem, file: str) -> InputProblem:
    found = _OF_SOLVE.fullmatch(problem.place)
    if found is None:
        return problem
    names = [name for name in found[1].split(", ") if name in SolverSection.model_fields]
    keys = ", ".join(f"solver.{name}" for name in names)
    return replace(problem, place=f"{file}: {keys or _ELSEWHERE.get(found[1], found[1])}")
