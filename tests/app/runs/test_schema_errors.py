"""Errors of keys that may have several types: one problem for each key, by its own name."""

import pytest
from pydantic import BaseModel, ConfigDict, ValidationError

from dvax.app.runs.schema_errors import translate


class Part(BaseModel):
    model_config = ConfigDict(strict=True)

    limits: float | list[float] = 0.0


class Section(BaseModel):
    model_config = ConfigDict(strict=True)

    upper: float | list[float] = 0.0
    names: dict[str, str] = {}
    few: int | None = None
    part: Part | None = None


@pytest.mark.parametrize(("given", "place", "rule"), [
    ({"upper": "600 mN"}, "model.upper", "it must be a number or a list"),
    ({"upper": True}, "model.upper", "it must be a number or a list"),
    ({"upper": [1.0, "a"]}, "model.upper[2]", "it must be a number"),
    ({"part": {"limits": "a"}}, "model.part.limits", "it must be a number or a list"),
    ({"names": {"float": 1.0}}, "model.names.float", "it must be a text in quotes"),
    ({"few": "a"}, "model.few", "it must be a whole number"),
])  # fmt: skip
def test_a_key_with_several_types_has_one_problem(given, place, rule):
    with pytest.raises(ValidationError) as caught:
        Section.model_validate(given)
    (problem,) = translate(caught.value, "file.toml", "model", Section)
    assert problem.place == f"file.toml: {place}" and problem.rule == rule
