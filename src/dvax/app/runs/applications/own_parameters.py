"""`[model.parameters]` of a problem of the user's own: the arguments of the function that builds it."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel, Field, ValidationError, create_model

from dvax.app.runs.keys import flat_keys, set_key
from dvax.app.runs.partial import validated_in_part
from dvax.app.runs.schema import Section, in_unit
from dvax.app.runs.schema_errors import translate, unknown_key
from dvax.errors import Problems, input_error

PREFIX = "parameters."
"""What the dotted keys of parameters begin with, below `[model]`."""


class Parameters:
    """The parameters of the function `build`, each with its type of `hints`, or one pydantic model.

    Annotated[float, "mm"] has a unit: a text such as "2 cm" is converted. A parameter of type
    `pathlib.Path` is a data file.

    **Raises:** `dvax.InputError` for a parameter without a type.
    """

    def __init__(self, build: Callable[..., Any], hints: Mapping[str, Any]):
        names = list(inspect.signature(build).parameters.values())
        only = hints.get(names[0].name) if len(names) == 1 else None
        self.kind: type[BaseModel]
        self._whole: str | None = None
        if isinstance(only, type) and issubclass(only, BaseModel):
            self.kind, self._whole = only, names[0].name
            return
        fields: dict[str, Any] = {}
        for p in names:
            if p.name not in hints or p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD):
                raise input_error(
                    f"model.python: {build.__name__}({p.name})", str(p), "each parameter has a type",
                    f"Write {p.name}: float = 1.0, or {p.name}: Annotated[float, \"mm\"]",
                )  # fmt: skip
            default = ... if p.default is p.empty else p.default
            # Numbers, flags and texts as they are; a list of TOML may be a tuple, a text a choice.
            strict = _plain(hints[p.name]) in (bool, int, float, str)
            about = None if unit_of(hints[p.name]) else f"a parameter of {build.__name__}"
            field: Any = Field(default, strict=strict, validate_default=True, description=about)
            fields[p.name] = (_with_unit(hints[p.name]), field)
        self.kind = create_model("Parameters", __base__=Section, **fields)

    def validated(self, given: Mapping[str, Any]) -> BaseModel:
        """Return the table of parameters, checked. **Raises:** `dvax.InputError`."""
        known = self._known(given)
        problems = Problems(
            unknown_key(f"model.{PREFIX}{key}", key, value, list(self.kind.model_fields))
            for key, value in given.items()
            if key not in known
        )
        try:
            made = self.kind.model_validate(known)
        except ValidationError as error:
            # The name of the file is added where it is known (`Wording`).
            found = translate(error, "", "model.parameters", self.kind)
            problems += [replace(p, place=p.place.removeprefix(": ")) for p in found]
            made = None
        problems.raise_any()
        assert made is not None
        return made

    def in_part(self, given: Mapping[str, Any]) -> BaseModel | None:
        """Return the table with defaults in the place of what is wrong in it, if there are such."""
        return validated_in_part(self.kind, self._known(given))

    def files(self, made: BaseModel, given: Mapping[str, Any]) -> dict[str, str]:
        """Return the names of the data files among the parameters `made` from the table `given`, by
        their dotted keys below `[model]`.

        **Raises:** `dvax.InputError` for a file that the table does not name, and for a list of files.
        """
        named, problems, found = flat_keys(given), Problems(), {}
        for key, value in flat_keys(made.model_dump()).items():
            place = f"model.{PREFIX}{key}"
            if isinstance(value, list | tuple | set) and any(isinstance(v, Path) for v in value):
                problems.add(
                    place, f"{len(value)} files in a list", "each data file has a key of its own",
                    "Write a parameter of type pathlib.Path for each file",
                )  # fmt: skip
            elif isinstance(value, Path) and key not in named:
                problems.add(
                    place, f"the default {str(value)!r}",
                    "the configuration names every data file, so that a run has its copy and its hash",
                    f'Write {key.rpartition(".")[2]} = "{value.name}" in the configuration',
                )  # fmt: skip
            elif isinstance(value, Path):
                found[f"{PREFIX}{key}"] = str(named[key])
        problems.raise_any()
        return found

    def arguments(self, made: BaseModel, located: Mapping[str, Path]) -> dict[str, Any]:
        """Return the arguments for the function. Data files have the paths `located`, by their dotted
        keys below `[model]`."""
        if located:
            table = complete(made)
            for key, path in located.items():
                set_key(table, key.removeprefix(PREFIX), str(path))
            made = self.validated(table)
        if self._whole is not None:
            return {self._whole: made}
        return {name: getattr(made, name) for name in self.kind.model_fields}

    def _known(self, given: Mapping[str, Any]) -> dict[str, Any]:
        allows_others = self.kind.model_config.get("extra") == "allow"
        return {k: v for k, v in given.items() if allows_others or k in self.kind.model_fields}


def complete(made: BaseModel) -> dict[str, Any]:
    """Return a checked table of parameters as a TOML file has it, with its defaults."""
    return made.model_dump(mode="json", exclude_none=True)


def unit_of(hint: Any) -> str | None:
    """Return the unit of a type, a text among its annotations."""
    return next((a for a in getattr(hint, "__metadata__", ()) if isinstance(a, str)), None)


def _plain(hint: Any) -> Any:
    """Return a type without its annotations."""
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _with_unit(hint: Any) -> Any:
    """Return a type whose unit converts quantities."""
    unit = unit_of(hint)
    if unit is None:
        return hint
    return Annotated[_plain(hint), in_unit(unit), Field(description=f"[{unit}]")]
