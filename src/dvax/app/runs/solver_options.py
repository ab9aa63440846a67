"""From the solver's keys of a configuration to the arguments of `dvax.solve`, for every model."""

from typing import Any

from dvax import evolution, vi
from dvax.app.runs.schema import SolverKeys
from dvax.errors import input_error
from dvax.evolution.arguments import ADAPTIVE_STEPS

MOST_STEPS = 2**30
"""The most fixed steps of a run."""
SEGMENTS = 100
"""The number of solves in a run of an application with at least as many saved times."""


def check_steps(keys: SolverKeys, span: float, words: str, table: str) -> None:
    """Raise an `InputError` where a fixed step is longer than the run, which has the length `span` (in
    `words`), or so short that steps cannot be counted. The keys stand in `table`."""
    for key, step in (("dt", keys.dt), ("dt_max", keys.dt_max)):
        if step is None:
            continue
        rule = ""
        if step > span:
            rule = f"a step is not longer than the run, which has {words}"
        elif key == "dt" and span / step >= MOST_STEPS:
            rule = f"a run has fewer than {MOST_STEPS} steps, or they cannot be counted"
        if rule:
            fix = f"Write {key} = {span / 100:.3g}, say, or leave it out"
            raise input_error(f"{table}.{key}", f"{step:g}", rule, fix)


def check_dt_max(keys: SolverKeys, span: float, table: str) -> None:
    """Raise an `InputError` where `dt_max` is so short that one solve, over a time of `span`, needs
    more than `max_steps` steps."""
    most = ADAPTIVE_STEPS if keys.max_steps is None else keys.max_steps
    if keys.dt_max is not None and span > most * keys.dt_max:
        raise input_error(
            f"{table}.dt_max",
            f"{keys.dt_max:g}",
            f"between two blocks of frames, {span:.3g} apart, steps no longer than that are more than "
            f"max_steps = {most}",
            f"Write dt_max = {_rounded_up(span / most)} or more, or a larger max_steps",
        )


def check_model_steps(keys: SolverKeys, span: float, words: str) -> None:
    """Both checks for an application, whose run has the length `span` (in `words`)."""
    check_steps(keys, span, words, "model")
    # Of at most a hundred segments, one is at least this long.
    check_dt_max(keys, span / SEGMENTS, "model")


def _rounded_up(number: float) -> str:
    """The number with two digits, rounded up."""
    shown = f"{number:.1e}"
    return shown if float(shown) >= number else f"{1.05 * number:.1e}"


def event_driven(table: SolverKeys) -> bool:
    """Return whether `dvax.PiecewiseLinear` solves a model that it can solve: where the file names
    no method and no option of time steppers."""
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
    # Steps are fixed or adaptive: keys of one kind drop the defaults of the other.
    adaptive = ("rtol", "atol", "dt_max")
    dropped = {"dt": adaptive, **dict.fromkeys(adaptive, ("dt",))}
    out = [other for name in given for other in dropped.get(name, ())]
    return {k: v for k, v in defaults.items() if k not in out} | given
