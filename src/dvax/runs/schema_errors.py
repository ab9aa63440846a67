"""Pydantic's findings in the words of a configuration file."""

from difflib import get_close_matches
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from dvax.errors import InputProblem

_TYPES = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "string_type": "a text in quotes",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "dict_type": "a table",
}


def shown(value: Any) -> str:
    """A value for a message: whole where short, its beginning where long."""
    text = repr(value)
    return text if len(text) <= 70 else text[:67] + "..."


def unknown_key(place: str, key: str, value: Any, known: list[str]) -> InputProblem:
    """A key that nothing reads, with the nearest one that something does."""
    close = get_close_matches(key, known, n=1)
    mend = f"Did you mean {close[0]!r}?" if close else f"Allowed here: {', '.join(known)}."
    return InputProblem(place, shown(value), f"there is no key {key!r} here", mend)


def translate(
    error: ValidationError, file: str, section: str, model: type[BaseModel]
) -> list[InputProblem]:
    """One problem for each finding: file and dotted key, what was given, the rule, the mend."""
    return [_problem(dict(e), file, section, model) for e in error.errors(include_url=False)]


def _problem(
    error: dict[str, Any], file: str, section: str, model: type[BaseModel]
) -> InputProblem:
    path = [str(part) for part in error["loc"]]
    place = f"{file}: {'.'.join([section, *path])}"
    owner, info = _owner(model, path)
    about = info.description if info is not None and info.description else "see the documentation"
    kind, context, given = error["type"], error.get("ctx", {}), shown(error["input"])
    key = path[-1] if path else section
    if kind == "extra_forbidden":
        return unknown_key(place, key, error["input"], list(owner.model_fields))
    if kind == "missing":
        return InputProblem(place, "nothing", f"it is required ({about})", f"Add {key} = ...")
    if kind == "rule":
        return InputProblem(place, given, context["rule"], f"{context['mend']}.")
    if kind in ("greater_than", "greater_than_equal", "less_than"):
        sign, bound = {
            "greater_than": ("greater than", context.get("gt")),
            "greater_than_equal": ("at least", context.get("ge")),
            "less_than": ("less than", context.get("lt")),
        }[kind]
        rule = f"it must be {sign} {bound:g} ({about})"
        return InputProblem(place, given, rule, "Give such a value; check its sign and unit.")
    if kind == "finite_number":
        return InputProblem(place, given, "it must be finite", "Write an ordinary number.")
    if kind == "literal_error":
        allowed = [str(a) for a in _literals(info)]
        close = get_close_matches(str(error["input"]), allowed, n=1)
        mend = f"Did you mean {close[0]!r}?" if close else "Choose one of these."
        return InputProblem(place, given, f"it is one of {', '.join(allowed)}", mend)
    if kind in _TYPES:
        return InputProblem(place, given, f"it must be {_TYPES[kind]} ({about})", "Mend the type.")
    return InputProblem(place, given, str(error["msg"]), "Mend the value.")


def _owner(model: type[BaseModel], path: list[str]) -> tuple[type[BaseModel], FieldInfo | None]:
    """The model in which the last part of a path stands, and that part's field if it has one."""
    owner, info = model, None
    for i, part in enumerate(path):
        info = owner.model_fields.get(part)
        if info is None or i == len(path) - 1:
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
    return () if info is None else get_args(info.annotation)
