"""Configurations of applications: `[model]` says everything, `[output]` what is written beside."""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from types import ModuleType
from typing import Any

from pydantic import BaseModel, ValidationError

from dvax.app.runs.applications.base import AbstractApplication
from dvax.app.runs.applications.wording import in_keys
from dvax.app.runs.config import Config, check_contact, parse
from dvax.app.runs.data_file import DataFile, fingerprint, locate, locate_folder
from dvax.app.runs.schema import SECTIONS, ModelSection, ReportSection, Section
from dvax.app.runs.schema_errors import shown, translate, unknown_key
from dvax.app.runs.units import Units
from dvax.errors import InputError, input_error

APPLICATIONS = ("traffic", "market", "frame", "circuit", "fem-contact")
"""The names of `[model]` that are applications."""

NAMES = ("contact", *APPLICATIONS)
_SECTIONS = ("model", "output")


def module_of(name: str) -> ModuleType:
    """The module of an application, imported when it is asked for."""
    return importlib.import_module(f"dvax.app.runs.applications.{name.replace('-', '_')}")


@dataclass(frozen=True)
class ModelConfig:
    """A checked configuration of an application, and the model that it describes."""

    name: str
    table: Section
    output: ReportSection
    source: Path
    application: AbstractApplication
    model: Any
    paths: Mapping[str, Path]

    def data_files(self) -> list[tuple[str, Path]]:
        """(key, file) of all the data: the files of a folder share its key."""
        found = []
        for key, path in self.paths.items():
            inside = self.application.folders.get(key)
            if inside is None:
                found.append((key, path))
            else:
                found += [(key, path / name) for name in inside if (path / name).is_file()]
        return found

    def fingerprints(self) -> list[DataFile]:
        """Size and SHA-256 of every data file."""
        return [fingerprint(path.name, path) for _, path in self.data_files()]

    def to_toml(self, paths: Mapping[str, str]) -> str:
        """All settings as TOML, with these names in the place of those of the data."""
        import tomli_w

        table = {**self.table.model_dump(exclude_none=True), **paths}
        output = self.output.model_dump(exclude_none=True)
        return tomli_w.dumps({"model": table, "output": output})


def read_config(
    path: str | Path, *, allow_outside: bool = False, quiet: bool = False
) -> Config | ModelConfig:
    """Read, check and complete a configuration file of any model; `quiet`: without lines of progress.

    **Raises:** `dvax.InputError` with all problems found, those of the data files included.
    """
    source = Path(path)
    raw = parse(source)
    table = raw.get("model")
    name = "contact"
    if table is None and not set(raw) & (set(SECTIONS) - {"output"}):
        given = "an empty file" if not raw else f"no [model], but {', '.join(raw)}"
        raise input_error(
            f"{source.name}: model", given,
            f"the table [model] says which model this is, one of {', '.join(NAMES)}",
            'Write [model] and below it name = "circuit", say, with the keys of that model',
        )  # fmt: skip
    if isinstance(table, Mapping):
        # A contact law needs no name: it was the only model once.
        name = table.get("name", "contact")
        if "name" not in table and (meant := _meant(table)) is not None:
            raise input_error(
                f"{source.name}: model.name", "nothing",
                f"it says which model this is, one of {', '.join(NAMES)}; "
                f"these keys are of {meant!r}",
                f'Add name = "{meant}"',
            )  # fmt: skip
    if name == "contact":
        return check_contact(raw, source, allow_outside)
    if not isinstance(name, str) or name not in APPLICATIONS:
        close = get_close_matches(str(name), NAMES, n=1)
        fix = f"Did you mean {close[0]!r}?" if close else "Choose one of these."
        raise input_error(
            f"{source.name}: model.name", shown(name), f"it is one of {', '.join(NAMES)}", fix
        )
    return _check(raw, name, source, allow_outside, quiet)


def _meant(table: Mapping[str, Any]) -> str | None:
    """The application whose keys a table without a name has; None where it has those of a contact
    law, or of no model."""

    def shared(section: type[BaseModel]) -> int:
        return len(set(table) & set(section.model_fields))

    if shared(ModelSection):
        return None
    count = {name: shared(module_of(name).APPLICATION.section) for name in APPLICATIONS}
    best = max(count, key=lambda name: count[name])
    return best if count[best] else None


def _check(
    raw: dict[str, Any], name: str, source: Path, allow_outside: bool, quiet: bool
) -> ModelConfig:
    file = source.name
    application = module_of(name).APPLICATION
    problems = [
        unknown_key(f"{file}: {key}", key, value, list(_SECTIONS))
        for key, value in raw.items()
        if key not in _SECTIONS
    ]
    sections: dict[str, Any] = {}
    for key, kind in (("model", application.section), ("output", ReportSection)):
        try:
            sections[key] = kind.model_validate(raw.get(key, {}), context={"units": Units()})
        except ValidationError as error:
            problems += translate(error, file, key, kind)
    if problems:
        raise InputError(*problems)
    table = sections["model"]
    paths: dict[str, Path] = {}
    for key in (*application.files, *application.folders):
        given = getattr(table, key)
        if given is None:
            continue
        find = locate if key in application.files else locate_folder
        try:
            paths[key] = find(given, source.parent, allow_outside, f"{file}: model.{key}")
        except InputError as error:
            problems += error.problems
    if problems:
        raise InputError(*problems)
    with in_keys(file, application):
        model = application.read(table, paths, quiet)
    return ModelConfig(name, table, sections["output"], source, application, model, paths)
