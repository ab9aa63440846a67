"""What a model says of its arguments, said of the keys of the configuration file."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from dvax.app.runs.applications.base import AbstractApplication
from dvax.errors import InputError, InputProblem

_ARGUMENTS = re.compile(r"dvax\.[\w.]+(?:\((?P<inside>[^()]*)\))?")


@contextmanager
def in_keys(file: str, application: AbstractApplication) -> Iterator[None]:
    """Problems that a model finds in its arguments, such as `dvax.models.Frame(period)`, name the key
    of `file` in their place, `model.period`."""
    try:
        yield
    except InputError as error:
        raise InputError(*(_said(p, file, application) for p in error.problems)) from error


def _said(problem: InputProblem, file: str, application: AbstractApplication) -> InputProblem:
    place, found = problem.place, _ARGUMENTS.fullmatch(problem.place)
    if found is not None:
        arguments = re.split(r",\s*", found["inside"] or "")
        keys = [key for argument in arguments for key in _keys(argument, application)]
        place = ", ".join(dict.fromkeys(keys))
    if re.match(r"model\b", place):
        place = f"{file}: {place}"
    # What Python calls None was left out of the file.
    return replace(
        problem, place=place, given="nothing" if problem.given == "None" else problem.given
    )


def _keys(argument: str, application: AbstractApplication) -> list[str]:
    """The keys that make an argument: those of the same name, but for the application's `keys`."""
    # An entry of a mapping is a key of its own; readers of a file count its tables from 1 on.
    path = re.sub(r"^\w+\['(\w+)'\]$", r"\1", argument)
    path = re.sub(r"\[(\d+)\]", lambda index: f"[{int(index[1]) + 1}]", path)
    *owner, last = path.split(".")
    whole = [".".join([*owner, key]) for key in application.keys.get(last, (last,))]
    known = application.section.model_fields
    return [f"model.{key}" if re.split(r"\W", key)[0] in known else "model" for key in whole]
