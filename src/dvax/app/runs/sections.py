"""Read the tables of a configuration file as sections."""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from dvax.app.runs.schema_errors import translate, unknown_key
from dvax.app.runs.units import Units
from dvax.errors import Problems


def read_sections(
    raw: Mapping[str, Any],
    kinds: Mapping[str, type[BaseModel]],
    file: str,
    required: frozenset[str] = frozenset(),
) -> dict[str, Any]:
    """Return the tables of a file as sections of these kinds, with numbers in the units of `[units]`.

    **Raises:** `dvax.InputError` with all problems of all tables.
    """
    problems, sections = Problems(), {}
    for key, value in raw.items():
        if key not in kinds:
            problems.append(unknown_key(f"{file}: {key}", key, value, list(kinds)))
    for name, kind in kinds.items():
        if name not in raw and name in required:
            problems.add(f"{file}: {name}", "nothing", "it is required", f"Add [{name}].")
            continue
        # Where the units are wrong, dimensions are still checked, in the default units.
        units = sections.get("units", Units())
        try:
            sections[name] = kind.model_validate(raw.get(name, {}), context={"units": units})
        except ValidationError as error:
            problems += translate(error, file, name, kind)
    problems.raise_any()
    return sections
