"""Configurations of applications: `[model]` says everything, `[output]` what is written beside."""

import importlib
import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from dvax.app.runs.applications import models
from dvax.app.runs.config import Config, check_contact
from dvax.app.runs.data_file import DataFile, fingerprint, locate
from dvax.app.runs.partial import validated_in_part
from dvax.app.runs.schema import SECTIONS, ModelSection, ReportSection, Section
from dvax.app.runs.schema_errors import shown
from dvax.app.runs.sections import read_sections
from dvax.app.runs.toml_file import read_toml
from dvax.app.runs.wording import Wording
from dvax.errors import InputError, Problems, input_error

if TYPE_CHECKING:
    from dvax.app.runs.applications.from_model import AbstractModelApplication

OWN = "python"
"""The name of `[model]` for a problem of the user's own."""

APPLICATIONS = tuple(
    sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(models.__path__))
)
"""The names of `[model]` that are applications: every module in `models`."""

NAMES = ("contact", *APPLICATIONS)


def module_of(name: str) -> ModuleType:
    """The module of an application, imported when it is asked for."""
    return importlib.import_module(f"{models.__name__}.{name.replace('-', '_')}")


@dataclass(frozen=True)
class ModelConfig:
    """A checked configuration of an application, and the model that it describes."""

    name: str
    table: Section
    output: ReportSection
    source: Path
    application: "type[AbstractModelApplication]"
    model: "AbstractModelApplication"
    paths: Mapping[str, Path]

    @property
    def title(self) -> str:
        """The title of the model, by default its name and the file of the configuration."""
        return self.model.own.title or f"{self.model.label or self.name}, {self.source.stem}"

    @property
    def wording(self) -> Wording:
        """The keys that the arguments of the model come from."""
        return wording_of(self.application, self.source.name)

    def is_folder(self, key: str) -> bool:
        """Whether a dotted key names a folder."""
        return key.removeprefix("model.") in self.application.folders

    def data_files(self) -> list[tuple[str, Path]]:
        """(dotted key, file) of all the data: the files of a folder share its key."""
        found = []
        for key, path in self.paths.items():
            inside = self.application.folders.get(key, ("",))
            files = [path / name for name in inside if (path / name).is_file()]
            # Of files with one name, the first is read.
            first = {file.name: file for file in reversed(files)}
            found += [(f"model.{key}", file) for file in files if first[file.name] == file]
        return found

    def fingerprints(self) -> list[DataFile]:
        """Size and SHA-256 of every data file; files of one name have their folders before it."""
        files = dict.fromkeys(path for _, path in self.data_files())
        names = [path.name for path in files]
        return [
            fingerprint(path.name if names.count(path.name) == 1 else self._name_of(path), path)
            for path in files
        ]

    def _name_of(self, path: Path) -> str:
        """Return the path of a file relative to the folder of the configuration, if it lies there."""
        folder = self.source.parent.resolve()
        return str(path.relative_to(folder) if path.is_relative_to(folder) else path)

    def tree(self) -> dict[str, Any]:
        """All settings as a TOML file has them."""
        return {
            "model": self.table.model_dump(exclude_none=True),
            "output": self.output.model_dump(exclude_none=True),
        }


def wording_of(application: "type[AbstractModelApplication]", file: str) -> Wording:
    """The keys of a `file` that the arguments of an application come from."""
    elsewhere = {} if application.end is None else {"t1": application.end}
    return Wording(file, "model", application.section, application.keys, elsewhere)


def read_config(
    path: str | Path,
    *,
    allow_outside: bool = False,
    quiet: bool = False,
    allow_code: bool = False,
) -> Config | ModelConfig:
    """Read, check and complete a configuration file of any model; `quiet`: without lines of progress;
    `allow_code`: a Python file that it names may run.

    **Raises:** `dvax.InputError` with all problems found, those of the data files included.
    """
    source = Path(path)
    return check_config(
        read_toml(source), source, allow_outside=allow_outside, quiet=quiet, allow_code=allow_code
    )


def check_config(
    raw: dict[str, Any],
    source: Path,
    *,
    allow_outside: bool = False,
    quiet: bool = False,
    allow_code: bool = False,
) -> Config | ModelConfig:
    """Check and complete a configuration that was parsed from the file `source`: `read_config`."""
    table = raw.get("model")
    name = "contact"
    if isinstance(raw.get("config"), str) and table is None:
        raise input_error(
            f"{source.name}: config", shown(raw["config"]), "a file with this key describes a sweep",
            f"Run it with dvax sweep {source.name} -o DIR",
        )  # fmt: skip
    unknown = [key for key in raw if key not in ("model", *SECTIONS)]
    has_name = isinstance(table, Mapping) and bool({"name", OWN} & set(table))
    if not has_name and (typo := get_close_matches("model", unknown, n=1)):
        raise input_error(
            f"{source.name}: {typo[0]}", f"[{typo[0]}]", "there is no table of this name here",
            "Did you mean [model]?",
        )  # fmt: skip
    if table is None and not set(raw) & (set(SECTIONS) - {"output"}):
        given = "an empty file" if not raw else f"no [model], but {', '.join(raw)}"
        raise input_error(
            f"{source.name}: model", given,
            f"the table [model] says which model this is, one of {', '.join(NAMES)}",
            'Write [model] and below it name = "circuit", say, with the keys of that model',
        )  # fmt: skip
    if isinstance(table, Mapping):
        # A contact law needs no name.
        name = table.get("name", OWN if OWN in table else "contact")
        if (
            "name" not in table
            and name != OWN
            and (likely := _likely_application(table)) is not None
        ):
            raise input_error(
                f"{source.name}: model.name", "nothing",
                f"it says which model this is, one of {', '.join(NAMES)}; "
                f"these keys are of {likely!r}",
                f'Add name = "{likely}"',
            )  # fmt: skip
    if name == "contact":
        return check_contact(raw, source, allow_outside)
    if not isinstance(name, str) or name not in APPLICATIONS:
        close = get_close_matches(str(name), NAMES, n=1)
        fix = f"Did you mean {close[0]!r}?" if close else "Choose one of these."
        raise input_error(
            f"{source.name}: model.name", shown(name), f"it is one of {', '.join(NAMES)}", fix
        )
    if name == OWN and not allow_code:
        raise input_error(
            f"{source.name}: model.{OWN}", shown(table.get(OWN) if isinstance(table, Mapping) else ""),
            "a run of this configuration executes the code of that file, which can do all that you can",
            "Read the file, and pass --allow-code if you trust it",
        )  # fmt: skip
    return _check(raw, name, source, allow_outside, quiet)


def _likely_application(table: Mapping[str, Any]) -> str | None:
    """Return the application whose keys a table without a name has; None where they are those of a
    contact law, or of no model."""

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
    file, problems = source.name, Problems()
    application = module_of(name).APPLICATION
    sections: dict[str, Any] = {}
    with problems.collect():
        kinds = {"model": application.section, "output": ReportSection}
        sections = read_sections(raw, kinds, file)
    table = sections.get("model") or validated_in_part(application.section, raw["model"])
    if table is None:
        raise InputError(*problems)
    paths: dict[str, Path] = {}
    with problems.collect():
        paths |= _located(application, table, source, allow_outside)
    if problems and not (application.is_checked_in_part and paths):
        raise InputError(*problems)
    try:
        with wording_of(application, file).in_keys():
            for key, given in application.further_files(table, paths).items():
                with problems.collect():
                    place = f"{file}: model.{key}"
                    paths[key] = locate(given, source.parent, allow_outside, place)
            model = application(table, paths, quiet)
    except InputError as error:
        raise InputError(*problems, *error.problems) from error
    problems.raise_any()
    return ModelConfig(name, model.table, sections["output"], source, application, model, paths)


def _located(
    application: "type[AbstractModelApplication]", table: Section, source: Path, allow_outside: bool
) -> dict[str, Path]:
    """Return the data files and folders that a table names, by their keys.

    **Raises:** `dvax.InputError` with all that are missing.
    """
    problems, paths = Problems(), {}
    for key in (*application.files, *application.folders):
        given = getattr(table, key)
        if isinstance(given, str):  # in the place of a file a key may have numbers
            place, is_folder = f"{source.name}: model.{key}", key in application.folders
            with problems.collect():
                paths[key] = locate(given, source.parent, allow_outside, place, is_folder=is_folder)
            for inside in application.folders.get(key, ()):
                # A link in the folder may lead out of it.
                if key in paths and (paths[key] / inside).is_file():
                    with problems.collect():
                        locate(f"{given}/{inside}", source.parent, allow_outside, place)
    problems.raise_any()
    return paths
