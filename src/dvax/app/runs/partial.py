"""Tables with errors, as far as they are right: what else is wrong can then be reported as well."""

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

Kind = TypeVar("Kind", bound=BaseModel)


def validated_in_part(kind: type[Kind], given: Mapping[str, Any]) -> Kind | None:
    """Return a table without its wrong keys, which then have their defaults; None if it is wrong
    without them too, for lack of a required key or by a rule between keys."""
    try:
        return kind.model_validate(given)
    except ValidationError as error:
        wrong = {place[0] for e in error.errors() if (place := e["loc"])}
    try:
        return kind.model_validate({k: v for k, v in given.items() if k not in wrong})
    except ValidationError:
        return None
