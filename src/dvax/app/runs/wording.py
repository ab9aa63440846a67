"""Problems and fixes that name arguments of Python, told with the keys of a configuration file."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import get_args

from dvax.app.runs.schema import Method, Section, ViSolver
from dvax.errors import Fix, InputError, InputProblem

_ARGUMENTS = re.compile(r"dvax\.[\w.]+(?:\((?P<inside>[^()]*)\))?")


@dataclass(frozen=True)
class Wording:
    """The keys of one `file` that the arguments of a model, or of `dvax.solve`, come from.

    An argument has the name of its key in `[table]`, whose schema is `section`, but for those that are
    `made_from` keys of other names, and those whose keys are `elsewhere` in the file.
    """

    file: str
    table: str
    section: type[Section]
    made_from: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    elsewhere: Mapping[str, str] = field(default_factory=dict)

    @contextmanager
    def in_keys(self) -> Iterator[None]:
        """Problems that are found in arguments, such as `dvax.models.Frame(period)`, name the key in
        their place, `model.period`."""
        try:
            yield
        except InputError as error:
            raise InputError(*map(self._reword, error.problems)) from error

    def fix(self, fix: Fix) -> str | None:
        """A fix as an instruction for the file; None for an option that the file does not have."""
        if not fix.option:
            return fix.why
        key = self.elsewhere.get(fix.option, f"{self.table}.{fix.option}")
        if fix.option not in {*self.elsewhere, *self.section.model_fields}:
            return None
        known = get_args(Method) + get_args(ViSolver)
        value = f'"{fix.value}"' if fix.value in known else fix.value
        return f"Write {key} = {value}, {fix.why}"

    def _reword(self, problem: InputProblem) -> InputProblem:
        place, found = problem.place, _ARGUMENTS.fullmatch(problem.place)
        if found is not None:
            arguments = re.split(r",\s*", found["inside"] or "")
            keys = [key for argument in arguments for key in self._keys(argument)]
            place = ", ".join(dict.fromkeys(keys))
        if re.match(rf"{self.table}\b", place) or place in self.elsewhere.values():
            place = f"{self.file}: {place}"
        # None in Python is a key that the file lacks.
        given = "nothing" if problem.given == "None" else problem.given
        return replace(problem, place=place, given=given)

    def _keys(self, argument: str) -> list[str]:
        """The keys that an argument is made from."""
        # An entry of a mapping is a key of its own; the tables of a file are counted from 1.
        path = re.sub(r"^\w+\['(\w+)'\]$", r"\1", argument)
        path = re.sub(r"\[(\d+)\]", lambda index: f"[{int(index[1]) + 1}]", path)
        if path in self.elsewhere:
            return [self.elsewhere[path]]
        *owner, last = path.split(".")
        whole = [".".join([*owner, key]) for key in self.made_from.get(last, (last,))]
        known = self.section.model_fields
        return [
            f"{self.table}.{key}" if re.split(r"\W", key)[0] in known else self.table
            for key in whole
        ]
