"""Translate errors of pydantic into problems of a configuration file."""

import json
import re
from dataclasses import replace
from difflib import get_close_matches
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from dvax.app.runs.units import NUMBER, converted
from dvax.errors import InputProblem

_TYPES = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "string_type": "a text in quotes",
    "bool_type": "true or false",
    "list_type": "a list",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "dict_type": "a table",
    "path_type": "the name of a file in quotes",
}
_LIMITS = {
    "greater_than": ("greater than", "gt"),
    "greater_than_equal": ("at least", "ge"),
    "less_than": ("less than", "lt"),
    "less_than_equal": ("at most", "le"),
    "too_short": ("a list of at least", "min_length"),
    "too_long": ("a list of at most", "max_length"),
}


def shown(value: Any) -> str:
    """Return a value as text for a message, cut off where it is long."""
    text = repr(value)
    return text if len(text) <= 70 else text[:67] + "..."


def unknown_key(place: str, key: str, value: Any, known: list[str]) -> InputProblem:
    """Return the problem of an unknown key, with the nearest known one."""
    close = get_close_matches(key, known, n=1)
    fix = f"Did you mean {close[0]!r}?" if close else f"Allowed here: {', '.join(known)}."
    return InputProblem(place, shown(value), f"there is no key {key!r} here", fix)


def translate(
    error: ValidationError, file: str, section: str, model: type[BaseModel]
) -> list[InputProblem]:
    """One problem for each key: file and dotted key, what was given, the rule, the fix."""
    groups: dict[tuple[str | int, ...], list[dict[str, Any]]] = {}
    for one in error.errors(include_url=False):
        found, path = dict(one), list(one["loc"])
        at = _alternative(model, path)
        # Of a key with several types pydantic has an error for each of them, named in the path.
        found["loc"] = tuple(path if at is None else path[:at] + path[at + 1 :])
        groups.setdefault(tuple(path[:at]), []).append(found)
    return [_joined(group, file, section, model) for group in groups.values()]


def _alternative(model: type[BaseModel], path: list[str | int]) -> int | None:
    """Return the number of the part of a path that names one of several types; None without one."""
    for k, part in enumerate(path[:-1]):
        info = model.model_fields.get(part) if isinstance(part, str) else None
        if info is None:
            return None
        inner = _model_within(info.annotation)
        if inner is not None:
            model = inner
            continue
        kinds = [a for a in get_args(info.annotation) if a is not NoneType]
        is_union = get_origin(info.annotation) in (Union, UnionType)
        return k + 1 if is_union and len(kinds) > 1 else None
    return None


def _joined(
    group: list[dict[str, Any]], file: str, section: str, model: type[BaseModel]
) -> InputProblem:
    """Return the problem of one key: that of the type which fits best, or of all if none does."""
    deepest = max(len(error["loc"]) for error in group)
    best = [error for error in group if len(error["loc"]) == deepest]
    problem = _problem(best[0], file, section, model)
    others = [_TYPES[error["type"]] for error in best[1:] if error["type"] in _TYPES]
    first = _TYPES.get(best[0]["type"])
    if not others or first is None:
        return problem
    rule = problem.rule.replace(first, " or ".join([first, *others]), 1)
    return replace(problem, rule=rule)


def _problem(
    error: dict[str, Any], file: str, section: str, model: type[BaseModel]
) -> InputProblem:
    path: list[str | int] = list(error["loc"])
    dotted = _dotted(section, path)
    place = f"{file}: {dotted}"
    owner, info = _owner(model, path)
    description = (info.description if info is not None else None) or ""
    about = f" ({description})" if description else ""
    kind, context, given = error["type"], error.get("ctx", {}), shown(error["input"])
    key = str(path[-1]) if path else section
    if kind == "extra_forbidden":
        return unknown_key(place, key, error["input"], list(owner.model_fields))
    if kind == "missing":
        sample = _sample(info)
        return InputProblem(place, "nothing", f"it is required{about}", f"Add {key} = {sample}")
    if kind == "rule":
        return InputProblem(place, given, context["rule"], f"{context['fix']}.")
    if kind in _LIMITS:
        sign, name = _LIMITS[kind]
        rule = f"it must be {sign} {context[name]:g}{about}"
        return InputProblem(place, given, rule, "Give such a value; check its size and unit.")
    if kind == "finite_number":
        return InputProblem(place, given, "it must be finite", "Write an ordinary number.")
    if kind == "literal_error":
        allowed = [str(a) for a in _literals(info)]
        close = get_close_matches(str(error["input"]), allowed, n=1)
        fix = f"Did you mean {close[0]!r}?" if close else "Choose one of these."
        return InputProblem(place, given, f"it is one of {', '.join(allowed)}", fix)
    inner = None if info is None else _model_within(info.annotation)
    if kind == "list_type" and inner is not None:
        example = ", ".join(f"{name} = {_sample(f)}" for name, f in inner.model_fields.items())
        rule = f"it is a list of tables{about}, each with a heading of its own"
        fix = f"Write [[{dotted}]] in double brackets, and below it {example}."
        return InputProblem(place, given, rule, fix)
    if kind in _TYPES:
        number, text = kind.startswith(("float", "int")), isinstance(error["input"], str)
        fix = _bare(key, error["input"], about) if number and text else f"Write {_TYPES[kind]}."
        return InputProblem(place, given, f"it must be {_TYPES[kind]}{about}", fix)
    return InputProblem(place, given, str(error["msg"]), "Fix the value.")


def _dotted(section: str, path: list[str | int]) -> str:
    """Return a dotted path; tables of a list are counted from 1."""
    return section + "".join(f"[{p + 1}]" if isinstance(p, int) else f".{p}" for p in path)


def _bare(key: str, text: str, about: str) -> str:
    """Return the fix for a text in place of a bare number: that number in the unit of the key,
    where the text states it."""
    found = re.search(r"\[([^\[\]]+)\]", about)
    unit = found[1] if found else None
    digits = text.strip()
    number = float(digits) if NUMBER.fullmatch(digits) else converted(text, unit or "1")
    fix = "Write a bare number, without quotes" + (f", in {unit}" if unit else " or a unit")
    if number is None:
        return f"{fix}."
    return f"{fix}: {key} = {number:.12g}" + (f"  # {unit}" if unit else "")


def _sample(info: FieldInfo | None) -> str:
    """Return an example value for a key in TOML, dots where there is none."""
    return json.dumps(info.examples[0]) if info is not None and info.examples else "..."


def _owner(
    model: type[BaseModel], path: list[str | int]
) -> tuple[type[BaseModel], FieldInfo | None]:
    """The model in which the last part of a path stands, and that part's field if it has one."""
    owner, info = model, None
    # Indices of lists lead to no other model.
    names = [part for part in path if isinstance(part, str)]
    for i, part in enumerate(names):
        info = owner.model_fields.get(part)
        if info is None or i == len(names) - 1:
            break
        inner = _model_within(info.annotation)
        if inner is None:
            break
        owner = inner
    return owner, info


def _model_within(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((m for a in get_args(annotation) if (m := _model_within(a)) is not None), None)


def _literals(info: FieldInfo | None) -> tuple[Any, ...]:
    """The values that a key may have, those of an optional key included."""
    return () if info is None else tuple(_values(info.annotation))


def _values(annotation: Any) -> list[Any]:
    if get_origin(annotation) is Literal:
        return list(get_args(annotation))
    return [value for part in get_args(annotation) for value in _values(part)]
