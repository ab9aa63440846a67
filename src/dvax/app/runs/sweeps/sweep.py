"""A sweep: a checked sweep file, and the configuration of each of its members."""

import copy
import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dvax.app.runs.applications.config import ModelConfig, check_config
from dvax.app.runs.config import Config
from dvax.app.runs.data_file import locate
from dvax.app.runs.keys import set_key
from dvax.app.runs.provenance import provenance
from dvax.app.runs.schema_errors import shown, translate, unknown_key
from dvax.app.runs.sweeps.members import parameters
from dvax.app.runs.sweeps.parameters import Parameter
from dvax.app.runs.sweeps.schema import SweepFile
from dvax.app.runs.toml_file import read_toml
from dvax.errors import InputError, input_error


@dataclass(frozen=True)
class Sweep:
    """The members of a sweep: configurations that differ in `parameters`, each with one value a
    member."""

    table: SweepFile
    source: Path
    base: Path
    raw: Mapping[str, Any]
    parameters: tuple[Parameter, ...]
    allow_outside: bool
    allow_code: bool
    _files: dict[tuple[Path, int, int], str] = field(default_factory=dict)

    @property
    def count(self) -> int:
        return len(self.parameters[0].values)

    def values(self, member: int) -> dict[str, Any]:
        """Return what the configuration of a member has at the swept keys."""
        return {p.key: p.values[member] for p in self.parameters}

    @contextmanager
    def naming(self, member: int) -> Iterator[None]:
        """Problems that the block raises name the member, and its values."""
        try:
            yield
        except InputError as error:
            who = f"{self.source.name}, member {member} ({values_text(self.values(member))})"
            raise InputError(
                *(replace(p, place=f"{who}: {p.place}") for p in error.problems)
            ) from error

    def tree(self, member: int) -> dict[str, Any]:
        """Return the configuration of a member as a TOML file has it.

        **Raises:** `dvax.InputError` where a swept key lies below a value.
        """
        raw = copy.deepcopy(dict(self.raw))
        for key, value in self.values(member).items():
            try:
                set_key(raw, key, value)
            except LookupError as error:
                name, given = error.args
                raise input_error(
                    f"{self.source.name}: {key}", repr(given)[:70],
                    f"{name} is no table in {self.base.name}", "Correct the key",
                ) from None  # fmt: skip
        return raw

    def config(self, member: int) -> Config | ModelConfig:
        """Return the checked configuration of a member. **Raises:** `dvax.InputError`."""
        return check_config(
            self.tree(member), self.base, allow_outside=self.allow_outside, quiet=True,
            allow_code=self.allow_code,
        )  # fmt: skip

    def hash(self, member: int) -> str:
        """Return the SHA-256 of what the results of a member depend on: its configuration, the content
        of the files that it names, and the versions of the software."""
        tree = {key: value for key, value in self.tree(member).items() if key != "output"}
        identity = [tree, self._contents(tree), self._versions]
        text = json.dumps(identity, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()

    @cached_property
    def _versions(self) -> dict[str, str]:
        made_by = provenance()
        packages = {name: made_by["packages"][name] for name in ("jax", "jaxlib", "numpy")}
        return {"dvax": made_by["dvax"], "precision": made_by["precision"], **packages}

    def _contents(self, tree: Any) -> list[str]:
        """Return the hashes of all files and folders whose names are texts of a configuration."""
        if isinstance(tree, Mapping):
            return [h for value in tree.values() for h in self._contents(value)]
        if isinstance(tree, list):
            return [h for value in tree for h in self._contents(value)]
        if not isinstance(tree, str) or not tree or "\x00" in tree or len(tree) > 1000:
            return []
        # A Python file may stand with its function: a.py:build.
        for name in (tree, tree.rpartition(":")[0]):
            path = self.base.parent / name
            if name and path.is_file():
                return [self._content(path)]
            if name and path.is_dir() and path.resolve() != self.base.parent.resolve():
                files = sorted(file for file in path.rglob("*") if file.is_file())
                return [f"{file.name} {self._content(file)}" for file in files]
        return []

    def _content(self, path: Path) -> str:
        about = path.stat()
        key = (path, about.st_mtime_ns, about.st_size)
        if key not in self._files:
            self._files[key] = hashlib.sha256(path.read_bytes()).hexdigest()
        return self._files[key]


def values_text(values: Mapping[str, Any]) -> str:
    """Return the values of a member for a message."""
    return ", ".join(f"{key} = {shown(value)}" for key, value in values.items())


def read_sweep(path: str | Path, *, allow_outside: bool = False, allow_code: bool = False) -> Sweep:
    """Read and check a sweep file, and read the configuration that it names.

    **Raises:** `dvax.InputError` with all problems found.
    """
    source = Path(path)
    raw = read_toml(source)
    table = _checked(raw, source.name)
    base = locate(table.config, source.parent, allow_outside, f"{source.name}: config")
    found = tuple(parameters(table, source, allow_outside))
    return Sweep(table, source, base, read_toml(base), found, allow_outside, allow_code)


def _checked(raw: dict[str, Any], file: str) -> SweepFile:
    known = list(SweepFile.model_fields)
    unknown = [unknown_key(f"{file}: {k}", k, v, known) for k, v in raw.items() if k not in known]
    if "config" not in raw and "model" in raw:
        raise input_error(
            f"{file}: model", "a table", "a sweep names the configuration that it varies",
            'Write config = "model.toml", and [model] into that file',
        )  # fmt: skip
    try:
        table = SweepFile.model_validate({k: v for k, v in raw.items() if k in known})
    except ValidationError as error:
        found = translate(error, file, "", SweepFile)
        # A key of the first level has no section before its dot.
        unknown += [replace(p, place=p.place.replace(f"{file}: .", f"{file}: ")) for p in found]
        table = None
    if unknown or table is None:
        raise InputError(*unknown)
    return table
